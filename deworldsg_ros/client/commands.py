"""Commands to a running graph: an operator's edits, save, load, clear, and any other service."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

from diagnostic_msgs.srv import AddDiagnostics
from std_srvs.srv import Trigger

from deworldsg_ros.client.errors import ClientError, NoService
from deworldsg_ros.client.objects import Point

# The types of the services of graph_node: with JSON in `load_namespace`, and without arguments.
TEXT_SERVICE, TRIGGER_SERVICE = AddDiagnostics, Trigger
# Either of these nodes has the graph.
NODES = ("graph_node", "deworldsg_node")
# The graph's thread may compile kernels, or write a large map.
TIMEOUT_S = 60.0
FIND_S = 10.0
# Between two looks whether the client was closed meanwhile.
STEP_S = 0.1


class GraphCommands:
    """Calls the services of the node with the graph. Its thread must be spinning.

    Every call raises ClientError with the node's own words if the node refuses it, or if there is
    no answer.
    """

    _node: Any
    _namespace: str
    _thread: threading.Thread | None
    _stop: threading.Event

    def _check_can_wait(self) -> None:
        """Raise ClientError if nothing can arrive any more while this thread waits."""
        if threading.current_thread() is self._thread:
            raise ClientError(
                "the client's own thread cannot wait for what it has to receive itself: call this "
                "from another thread"
            )
        if self._stop.is_set():
            raise ClientError("the client is closed")

    def set_label(self, node: int, label: str) -> dict[str, Any]:
        """Set the class of an object."""
        return self.command("set_label", node=node, label=label)

    def merge(self, a: int, b: int) -> dict[str, Any]:
        """Make two objects one; the answer has its id under ``nodes``."""
        return self.command("merge", nodes=[a, b])

    def split(self, node: int, near_m: tuple[Point, Point] | None = None) -> dict[str, Any]:
        """Make an object two; see `scene.edits.SplitNode`."""
        return self.command("split", node=node, near_m=near_m)

    def delete(self, node: int) -> dict[str, Any]:
        """Delete an object: it does not come back from the same place and class."""
        return self.command("delete", node=node)

    def undo(self) -> dict[str, Any]:
        """Undo the newest edit that was not undone yet, of any user."""
        answer: dict[str, Any] = json.loads(self._call("undo", None))
        return answer

    def save(self) -> str:
        """Write the files of the node; returns a sentence."""
        return self._call("save", None)

    def clear(self) -> str:
        """Begin with an empty graph; returns a sentence."""
        return self._call("clear", None)

    def load(self, path: str) -> str:
        """Continue with a map file of the robot; returns a sentence."""
        return self._call("load", {"path": path})

    def command(self, service: str, **request: Any) -> dict[str, Any]:
        """Call a service that takes and answers JSON."""
        answer: dict[str, Any] = json.loads(self._call(service, request))
        return answer

    def _call(self, service: str, request: dict[str, Any] | None) -> str:
        try:
            return self._answer(service, request)
        except ClientError:
            raise
        except Exception:
            self._check_can_wait()  # without its node, a closed client has errors of ROS
            raise

    def _answer(self, service: str, request: dict[str, Any] | None) -> str:
        kind = TRIGGER_SERVICE if request is None else TEXT_SERVICE
        client = self._node.create_client(kind, self._find(service))
        try:
            message = kind.Request()
            if request is not None:
                message.load_namespace = json.dumps(request)
            end_s = time.monotonic() + TIMEOUT_S
            arrived = threading.Event()
            while not client.service_is_ready() and time.monotonic() < end_s:
                self._check_can_wait()
                time.sleep(0.02)
            future = client.call_async(message)
            future.add_done_callback(lambda _: arrived.set())
            while not arrived.wait(STEP_S):
                self._check_can_wait()
                if time.monotonic() > end_s:
                    raise ClientError(f"no answer of {client.srv_name} within {TIMEOUT_S:g} s")
            response = future.result()
        finally:
            self._node.destroy_client(client)
        if not response.success:
            raise ClientError(response.message)
        return str(response.message)

    def _find(self, service: str) -> str:
        """The name of a service of the node with the graph."""
        end_s = time.monotonic() + FIND_S
        names = [f"{self._namespace}/{node}/{service}" for node in NODES]
        while time.monotonic() < end_s:
            self._check_can_wait()
            known = dict(self._node.get_service_names_and_types())
            found = [name for name in names if name in known]
            if found:
                return found[0]
            time.sleep(0.05)
        raise NoService(
            f"no service {' or '.join(names)} within {FIND_S:g} s: is graph_node running, and are "
            "ROS_DOMAIN_ID and the namespace the same?"
        )
