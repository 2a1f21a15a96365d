"""The graph for Foxglove: a WebSocket server without ROS. Needs the package foxglove-sdk."""

from __future__ import annotations

import asyncio
import http.client
import io
import secrets
import threading
from collections.abc import Collection, Iterable
from concurrent.futures import Future
from contextlib import closing, suppress

import foxglove
import numpy as np
from foxglove import channels, messages

from deworldsg_ros.client.objects import SceneObject, scene_object
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.view.colours import QUIET, class_colours, to_rgb
from deworldsg_ros.view.live.camera import CameraView, jpeg, with_masks
from deworldsg_ros.view.live.state import Guard, up_of
from deworldsg_ros.view.page import in_words
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

# One topic each, so that Foxglove can switch them.
OBJECTS, RELATIONS, NEAR = "/scene_graph/objects", "/scene_graph/relations", "/scene_graph/near"
IMAGE, TRANSFORMS, CAMERA_FRAME = "/camera/image", "/tf", "deworldsg_camera"
TEXT_PX, SHAFT_M, HEAD_M, HEAD_LENGTH_M = 12.0, 0.012, 0.035, 0.06
OPACITY, RELATION_RGBA = 0.4, (0.95, 0.75, 0.2, 0.9)

# Of its web application and of its desktop; and of Lichtblick, on this machine.
ORIGINS = ("https://app.foxglove.dev", "file://", Guard.LOCAL)
# The head of a request is no longer, in bytes and in time.
HEAD_BYTES, HEAD_S = 16_384, 10.0
BLOCK_BYTES = 65_536


class FoxgloveServer(foxglove.ServerListener):
    """Sends a graph to Foxglove. Its methods may be called from any thread.

    Args:
        host: address to listen on; 127.0.0.1 = only this machine.
        port: of the WebSocket; 0 = a free one.

    Attributes:
        url: of the WebSocket, with its secret.
        guard: refuses who does not know the secret.
    """

    def __init__(self, host: str, port: int) -> None:
        self._lock = threading.RLock()
        self._replica = GraphReplica()
        self._objects: dict[int, SceneObject] = {}
        self._sent: set[Pair] = set()
        self._context = foxglove.Context()
        self._scenes = {
            topic: channels.SceneUpdateChannel(topic, context=self._context)
            for topic in (OBJECTS, RELATIONS, NEAR)
        }
        self._image = channels.CompressedImageChannel(IMAGE, context=self._context)
        self._transforms = channels.FrameTransformChannel(TRANSFORMS, context=self._context)
        # The SDK asks for neither origin nor secret. Its server has one of 2^24 addresses of this
        # machine, with a port of 2^15, which no page finds; others come through the gate.
        inner = "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))
        self._server = foxglove.start_server(
            name="DeWorldSG", host=inner, port=0, server_listener=self, context=self._context
        )
        self.guard = Guard(host, "ws", ORIGINS)
        try:
            self._gate = Gate(host, port, (inner, self._server.port), self.guard)
        except OSError:
            self._server.stop()
            raise
        self.url = self.guard.url(self._gate.port)

    @property
    def session(self) -> str | None:
        """The session of the graph."""
        return self._replica.session

    @property
    def sequence(self) -> int:
        """Number of the newest update."""
        return self._replica.sequence

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Continue with a snapshot."""
        with self._lock:
            self._replica.reset(snapshot)
            self._send_all()

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; False for one that is known. Raises RefusedInput after a gap."""
        with self._lock:
            applied = self._replica.apply(update)
            if applied:
                self._send({node.id for node in update.nodes}, update)
            return applied

    def see(self, space: SeenSpace) -> None:
        """Do nothing: Foxglove shows the graph and the camera."""

    def correct(self, change: TrailChange) -> None:
        """Do nothing, as `see`."""

    def look(self, view: CameraView) -> None:
        """Send a frame of the camera: the image with its masks, and its pose."""
        with self._lock:
            image = with_masks(view, self._colours())
            frame_id = self._replica.frame_id
        stamp = _stamp(view.stamp_ns)
        T = view.T_world_camera
        self._transforms.log(
            messages.FrameTransform(
                timestamp=stamp,
                parent_frame_id=frame_id,
                child_frame_id=CAMERA_FRAME,
                translation=_vector(T[:3, 3]),
                rotation=_quaternion(quaternion_from_rotation(T[:3, :3])),
            )
        )
        if image is not None:
            self._image.log(
                messages.CompressedImage(
                    timestamp=stamp, frame_id=CAMERA_FRAME, data=jpeg(image), format="jpeg"
                )
            )

    def say(self, why_empty: str) -> None:
        """Foxglove has no place for the reason of an empty graph."""

    def on_subscribe(self, client: object, channel: object) -> None:
        """A client that comes later gets the whole graph."""
        with self._lock:
            self._send_all()

    def close(self) -> None:
        """End the server."""
        self._gate.close()
        self._server.stop()

    def _send_all(self) -> None:
        everything = messages.SceneEntityDeletion(type=messages.SceneEntityDeletionType.All)
        for channel in self._scenes.values():
            channel.log(messages.SceneUpdate(deletions=[everything]))
        self._objects, self._sent = {}, set()
        self._send(set(self._replica.nodes), None)

    def _send(self, changed: Collection[int], update: wire.SceneGraphUpdateMessage | None) -> None:
        """Send changed objects and the relations that they, or the update, have changed."""
        replica, up = self._replica, up_of(self._replica)
        for node_id in self._objects.keys() - replica.nodes.keys():
            del self._objects[node_id]
            self._delete(OBJECTS, f"object {node_id}")
        for node_id in changed:
            self._objects[node_id] = scene_object(replica.nodes[node_id], replica.frame_id, up)
        for pair in self._sent - replica.edges.keys():
            self._sent.discard(pair)
            for topic in (RELATIONS, NEAR):
                self._delete(topic, _name(pair))
        pairs = {(edge.subject, edge.object) for edge in update.edges} if update else set()
        pairs |= {pair for pair in replica.edges if not changed.isdisjoint(pair)}  # type: ignore[attr-defined]
        colours = self._colours()
        self._log(OBJECTS, [self._object(self._objects[i], colours[i]) for i in changed])
        for pair in pairs & replica.edges.keys():
            edge = replica.edges[pair]
            if pair[0] in self._objects and pair[1] in self._objects:
                topic = NEAR if edge.predicate in QUIET else RELATIONS
                self._delete(RELATIONS if topic == NEAR else NEAR, _name(pair))
                self._log(topic, [self._relation(edge)])
                self._sent.add(pair)

    def _colours(self) -> dict[int, str]:
        labels = {node_id: self._objects[node_id].label for node_id in sorted(self._objects)}
        colours = class_colours(labels.values())
        return {node_id: colours[label] for node_id, label in labels.items()}

    def _log(self, topic: str, entities: list[messages.SceneEntity]) -> None:
        self._scenes[topic].log(messages.SceneUpdate(entities=entities))

    def _delete(self, topic: str, name: str) -> None:
        deletion = messages.SceneEntityDeletion(id=name)
        self._scenes[topic].log(messages.SceneUpdate(deletions=[deletion]))

    def _object(self, item: SceneObject, colour: str) -> messages.SceneEntity:
        top = np.array(item.position_m) + (item.size_m[2] / 2 + 0.05) * np.array(item.up)
        pose = messages.Pose(
            position=_vector(item.position_m), orientation=_quaternion(item.orientation_xyzw)
        )
        tint = messages.Color(**dict(zip("rgb", to_rgb(colour))), a=OPACITY)
        facts = {
            "class": in_words(item),
            "probability": f"{item.probability:.2f}",
            "observations": str(item.observations),
            **{belief.label: f"{belief.probability:.2f}" for belief in item.classes},
        }
        return messages.SceneEntity(
            frame_id=item.frame_id,
            id=f"object {item.id}",
            metadata=_pairs(facts.items()),
            cubes=[messages.CubePrimitive(pose=pose, size=_vector(item.size_m), color=tint)],
            texts=[_text(top, f"{item.label} {item.id}")],
        )

    def _relation(self, edge: wire.EdgeState) -> messages.SceneEntity:
        tail, tip = (np.array(self._objects[i].position_m) for i in (edge.subject, edge.object))
        length = float(np.linalg.norm(tip - tail))
        direction = (tip - tail) / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
        _, *others = np.roll(horizontal_axes(direction.tolist()), 1, axis=0)
        rotation = np.stack([direction, *others], axis=1)
        arrow = messages.ArrowPrimitive(
            pose=messages.Pose(
                position=_vector(tail), orientation=_quaternion(quaternion_from_rotation(rotation))
            ),
            shaft_length=max(length - HEAD_LENGTH_M, 0.0),
            shaft_diameter=SHAFT_M,
            head_length=HEAD_LENGTH_M,
            head_diameter=HEAD_M,
            color=messages.Color(**dict(zip("rgba", RELATION_RGBA))),
        )
        return messages.SceneEntity(
            frame_id=self._replica.frame_id,
            id=_name((edge.subject, edge.object)),
            metadata=_pairs([("probability", f"{edge.probability:.2f}")]),
            arrows=[arrow],
            texts=[_text(tail + 0.5 * (tip - tail), edge.predicate)],
        )


def _name(pair: Pair) -> str:
    return f"relation {pair[0]} {pair[1]}"


def _pairs(items: Iterable[tuple[str, str]]) -> list[messages.KeyValuePair]:
    return [messages.KeyValuePair(key=key, value=value) for key, value in items]


def _text(position: Float64, text: str) -> messages.TextPrimitive:
    return messages.TextPrimitive(
        pose=messages.Pose(position=_vector(position), orientation=_quaternion((0, 0, 0, 1))),
        billboard=True,
        font_size=TEXT_PX,
        scale_invariant=True,
        color=messages.Color(r=1.0, g=1.0, b=1.0, a=1.0),
        text=text,
    )


def _vector(values: Iterable[float]) -> messages.Vector3:
    return messages.Vector3(**dict(zip("xyz", map(float, values))))


def _quaternion(values: Iterable[float]) -> messages.Quaternion:
    return messages.Quaternion(**dict(zip("xyzw", map(float, values))))


def _stamp(stamp_ns: int) -> messages.Timestamp:
    return messages.Timestamp(*divmod(stamp_ns, 10**9))


class Gate:
    """Passes connections that a guard lets in to a server; refuses others with 403.

    Args:
        host: address to listen on.
        port: to listen on; 0 = a free one.
        inner: address and port of the server.
        guard: is asked once a connection.

    Attributes:
        port: it listens on.

    Raises:
        OSError: if this machine cannot listen there.
    """

    def __init__(self, host: str, port: int, inner: tuple[str, int], guard: Guard) -> None:
        self._inner, self._guard = inner, guard
        self._stop = asyncio.Event()
        started: Future[tuple[asyncio.AbstractEventLoop, int]] = Future()
        work = self._run(host, port, started)
        self._thread = threading.Thread(target=asyncio.run, args=[work], name="gate", daemon=True)
        self._thread.start()
        self._loop, self.port = started.result()

    def close(self) -> None:
        """End all connections."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(timeout=5.0)

    async def _run(
        self, host: str, port: int, started: Future[tuple[asyncio.AbstractEventLoop, int]]
    ) -> None:
        try:
            server = await asyncio.start_server(self._serve, host, port, limit=HEAD_BYTES)
        except OSError as error:
            started.set_exception(error)
            return
        started.set_result((asyncio.get_running_loop(), server.sockets[0].getsockname()[1]))
        await self._stop.wait()
        server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # Besides what a connection ends with: no request, or none that is HTTP.
        ends = (OSError, EOFError, ValueError, asyncio.LimitOverrunError, asyncio.TimeoutError)
        with closing(writer), suppress(*ends, http.client.HTTPException):
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
            line, _, fields = head.partition(b"\r\n")
            method, target, version = line.decode("latin-1").split(" ")
            path = self._guard.path(target, http.client.parse_headers(io.BytesIO(fields)))
            if path is None:
                writer.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n")
                writer.write(b"Connection: close\r\n\r\n")
                await writer.drain()
                return
            from_inner, to_inner = await asyncio.open_connection(*self._inner)
            with closing(to_inner):
                to_inner.write(f"{method} {path} {version}\r\n".encode("latin-1") + fields)
                both = _pump(reader, to_inner), _pump(from_inner, writer)
                tasks = [asyncio.ensure_future(pump) for pump in both]
                _, others = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in others:
                    task.cancel()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while block := await reader.read(BLOCK_BYTES):
            writer.write(block)
            await writer.drain()
