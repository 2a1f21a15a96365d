"""Four node processes, and a camera that repeats a recording for ever with stamps that grow."""

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from support.browser import free_port
from support.nodes import ROOT, TOPICS, Camera, NodeProcess, Peer

from deworldsg_ros.cli.terminal import dds_environment
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.source import RawRoleMessage, Role
from deworldsg_ros.wire import messages as wire

NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")
RECORDING = ROOT / "bags" / "demo_room"
# Frames that may wait for their results, while there are results at all.
WINDOW_FRAMES = 3
SILENCE_S = 1.0
# In the CDR encoding, the stamp of the header is the first field after the four bytes of its kind.
STAMP, STAMP_AT = struct.Struct("<iI"), 4


# Follows the graph, asks it, and looks at each change.
CLIENT = """
import time
from deworldsg_ros.client import SceneGraphClient
from deworldsg_ros.client.questions import ask
with SceneGraphClient() as client:
    client.on_change(lambda graph, changes: changes.lines)
    client.wait(1, 300)
    while True:
        ask(client.graph, "what is on the table")
        time.sleep(0.5)
"""


class Rig:
    """The nodes and their camera; `folder` is for everything that the nodes write."""

    def __init__(self, folder: Path) -> None:
        # A domain of its own, and shared memory for images, also outside of pytest.
        os.environ.update(dds_environment())
        self._folder, self.map_path = folder, folder / "room.map"
        self.processes: dict[str, NodeProcess] = {}
        self.client: subprocess.Popen[bytes] | None = None
        self.peer = Peer("endurance")
        self.graph: wire.SceneGraphMessage | None = None  # the newest whole one
        self.updates = 0
        self.published: dict[str, set[int]] = {}  # ids of each session, in updates
        self.kept: set[int] = set()  # ids of the map with which the newest session began
        self.values: dict[str, dict[str, str]] = {}  # newest diagnostics of each node
        self._graph_texts = self.peer.collect("/scene_graph", 1, latched=True)
        self._update_texts = self.peer.collect("/scene_graph/updates")
        self._results = self.peer.collect("deworldsg/local_graph")
        self._statuses = self.peer.statuses()
        source = open_source(RECORDING)
        self._messages = list(source.raw_messages())
        source.close()
        self._camera = Camera(self.peer, self._messages)
        self._first_ns = self._messages[0].stamp_ns
        self._length_ns = self._messages[-1].stamp_ns - self._first_ns + 10**8
        self._next = self._in_flight = 0
        self._started_s = self._last_s = self._result_s = 0.0

    def start(self, name: str) -> None:
        folder = self._folder / str(time.monotonic_ns())
        folder.mkdir(parents=True)
        parameters = {"map_path": f"'{self.map_path}'"}
        self.processes[name] = NodeProcess(name, folder, parameters=parameters)

    def start_others(self) -> None:
        """Start everything else that a user starts: one process for all stages, in a namespace of
        its own, the viewer, the fleet with one robot, and a Python client."""
        endpoint = f"'tcp/127.0.0.1:{free_port()}'"
        own = [word for topic in TOPICS.values() for word in ("-r", f"{topic}:=/{topic}")]
        others: dict[str, tuple[list[str], dict[str, object]]] = {
            "deworldsg_node": (["-r", "__ns:=/single", *own], {}),
            "viewer_node": ([], {"port": free_port()}),
            "fleet_node": ([], {"listen": endpoint}),
            "fleet_link_node": ([], {"connect": endpoint, "robot": "ada"}),
        }
        for name, (arguments, parameters) in others.items():
            folder = self._folder / name
            folder.mkdir()
            self.processes[name] = NodeProcess(name, folder, *arguments, parameters=parameters)
        for name in others:
            self.processes[name].wait_ready()
        with (self._folder / "client.log").open("w") as log:
            self.client = subprocess.Popen(
                [sys.executable, "-c", CLIENT], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT
            )

    def start_all(self) -> None:
        for name in NODES:
            self.start(name)
        for process in self.processes.values():
            process.wait_ready()
        self._camera.wait_for_subscribers()
        self._started_s = self._last_s = time.monotonic()

    def kill(self, name: str) -> None:
        """Kill a node as the operating system does: without a word."""
        process = self.processes[name]
        os.kill(process.pid, signal.SIGKILL)
        process.wait(10)

    def run(self, limit_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Publish frames at their pace until a condition is true; False at the limit."""
        end_s = time.monotonic() + limit_s
        while not until():
            if time.monotonic() > end_s:
                return False
            self._publish_due()
            self.peer.spin_for(0.01)
            self._read()
        return True

    def close(self) -> None:
        if self.client is not None:
            self.client.kill()
            self.client.wait(10)
        for process in self.processes.values():
            process.end()
        self.peer.close()

    def _publish_due(self) -> None:
        """Publish what is due. A slow machine gets fewer frames, as with replay_node."""
        now_s = time.monotonic()
        if self._in_flight >= WINDOW_FRAMES and now_s - self._result_s < SILENCE_S:
            self._started_s += now_s - self._last_s  # the clock of the recording stands still
        self._last_s = now_s
        while True:
            round_, index = divmod(self._next, len(self._messages))
            message = self._messages[index]
            due_ns = message.stamp_ns - self._first_ns + round_ * self._length_ns
            if due_ns > (now_s - self._started_s) * 1e9:
                return
            self._camera.publish(message, shifted(message, round_ * self._length_ns))
            self._in_flight += message.role is Role.RGB
            self._next += 1

    def _read(self) -> None:
        self.updates += len(self._update_texts)
        for text in self._update_texts:
            update = wire.decode(text, wire.SceneGraphUpdateMessage)
            ids = self.published.setdefault(str(update.session), set())
            ids.update(node.id for node in update.nodes)
        if self._results:  # a result also ends the frames before it
            self._in_flight, self._result_s = 0, time.monotonic()
        if self._graph_texts:
            self.graph = wire.decode(self._graph_texts[-1], wire.SceneGraphMessage)
        for status in self._statuses:
            values = {item.key: item.value for item in status.values}
            self.values[status.name.split(":")[0]] = values
        for arrived in (self._update_texts, self._results, self._graph_texts, self._statuses):
            arrived.clear()


def shifted(message: RawRoleMessage, by_ns: int) -> bytes:
    data = bytearray(message.data)
    STAMP.pack_into(data, STAMP_AT, *divmod(message.stamp_ns + by_ns, 10**9))
    return bytes(data)
