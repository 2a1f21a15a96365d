"""A node whose topics take `qos_overrides.*`, as those of other ROS 2 nodes do."""

from __future__ import annotations

from typing import Any

from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import QoSOverridingOptions

from deworldsg_ros.scene.errors import ConfigurationError

PREFIX = "qos_overrides."


class OverridableNode(Node):
    """Applies ``qos_overrides./TOPIC.publisher.POLICY`` and ``….subscription.POLICY``.

    Only overrides that are given become parameters: the QoS of the camera's topics follows their
    publishers without one.
    """

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
        """As rclpy's; raises ConfigurationError for an override that rclpy does not take."""
        arguments = (msg_type, topic, qos_profile)
        return self._create(super().create_publisher, "publisher", arguments, options)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Any:
        """As rclpy's; raises ConfigurationError for an override that rclpy does not take."""
        arguments = (msg_type, topic, callback, qos_profile)
        return self._create(super().create_subscription, "subscription", arguments, options)

    def unused_overrides(self) -> list[str]:
        """The overrides of topics that the node does not have so far."""
        return [name for name in self._qos_overrides() if not self.has_parameter(name)]

    def _qos_overrides(self) -> list[str]:
        # rclpy's own publishers are made before it has read the overrides.
        given = getattr(self, "_parameter_overrides", {})
        return [name for name in given if name.startswith(PREFIX)]

    def _create(
        self, create: Any, kind: str, arguments: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        prefix = f"{PREFIX}{self.resolve_topic_name(arguments[1])}.{kind}."
        names = [name for name in self._qos_overrides() if name.startswith(prefix)]
        if not names:
            return create(*arguments, **options)
        try:
            policies = [QoSPolicyKind[name[len(prefix) :].upper()] for name in names]
            options["qos_overriding_options"] = QoSOverridingOptions(policies)
            return create(*arguments, **options)
        except (KeyError, RuntimeError, InvalidParameterTypeException, ParameterException) as error:
            given = ", ".join(
                f"{name} = {self._parameter_overrides[name].value!r}" for name in names
            )
            raise ConfigurationError(
                f"{self.get_name()}: {given}: {error}; expected policies of "
                "rclpy.qos.QoSPolicyKind with their values, e.g. reliability: best_effort"
            ) from error
