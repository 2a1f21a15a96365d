"""The graph for Foxglove: a WebSocket server without ROS. Needs the package foxglove-sdk."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable

import foxglove
import numpy as np
from foxglove import channels, messages

from deworldsg_ros.client.objects import SceneObject, scene_object
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.view.colours import QUIET, class_colours, to_rgb
from deworldsg_ros.view.live.camera import CameraView, jpeg, with_masks
from deworldsg_ros.view.live.details import in_words
from deworldsg_ros.view.live.state import up_of
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

# One topic each, so that Foxglove can switch them.
OBJECTS, RELATIONS, NEAR = "/scene_graph/objects", "/scene_graph/relations", "/scene_graph/near"
IMAGE, TRANSFORMS, CAMERA_FRAME = "/camera/image", "/tf", "deworldsg_camera"
TEXT_PX, SHAFT_M, HEAD_M, HEAD_LENGTH_M = 12.0, 0.012, 0.035, 0.06
OPACITY, RELATION_RGBA = 0.4, (0.95, 0.75, 0.2, 0.9)


class FoxgloveServer(foxglove.ServerListener):
    """Sends a graph to Foxglove. Its methods may be called from any thread.

    Args:
        host: address to listen on; 127.0.0.1 = only this machine.
        port: of the WebSocket; 0 = a free one.

    Attributes:
        url: of the WebSocket.
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
        self._server = foxglove.start_server(
            name="DeWorldSG", host=host, port=port, server_listener=self, context=self._context
        )
        self.url = f"ws://{host}:{self._server.port}"

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
