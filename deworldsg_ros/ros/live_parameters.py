"""Parameters that change while a node runs."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node

from deworldsg_ros.ros.parameters import changed
from deworldsg_ros.scene.errors import ConfigurationError


class LiveParameters:
    """Checks changes and passes them on; rclpy refuses those of read-only parameters.

    Args:
        node: with the attribute `parameters`, and `configure` to take changed ones.
    """

    def __init__(self, node: Any) -> None:
        self._node: Any = node
        ros_node: Node = node
        ros_node.add_on_set_parameters_callback(self._check)
        ros_node.add_post_set_parameters_callback(self._take)

    def _changed(self, parameters: list[Any]) -> Any:
        values = {item.name: item.value for item in parameters}
        return changed(self._node.parameters, values, self._node.get_name())

    def _check(self, parameters: list[Any]) -> SetParametersResult:
        try:
            self._changed(parameters)
        except ConfigurationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Any]) -> None:
        before = self._node.parameters
        self._node.parameters = self._changed(parameters)
        if self._node.parameters != before:
            self._node.configure()
