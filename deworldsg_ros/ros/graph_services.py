"""The services of a node with a graph: save, load, clear, questions, and an operator's edits.

ROS 2 has no service type for a text and an answer, and this package defines no types of its own. So
services without arguments are std_srvs/Trigger. The others are diagnostic_msgs/AddDiagnostics,
which has the fields of such a service: the request is JSON in `load_namespace`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
from diagnostic_msgs.srv import AddDiagnostics
from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Trigger

from deworldsg_ros.base.files import parse_json
from deworldsg_ros.client.goals import Goal, Robot
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.next_view import NOTHING
from deworldsg_ros.client.questions import ask
from deworldsg_ros.graph.edits import (
    DeleteNode,
    GraphEdit,
    MergeNodes,
    NameRoom,
    SetLabel,
    SplitNode,
    Undo,
)
from deworldsg_ros.graph.extent import DEFAULT_UP
from deworldsg_ros.graph.seen_cells import SeenCells
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map
from deworldsg_ros.ros.graph_keeper import GraphKeeper
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.threads import Worker
from deworldsg_ros.scene.errors import DeWorldSGError, RefusedInput
from deworldsg_ros.wire.fields import Point

GOAL_TOPIC = "deworldsg/goal"
# A question is a line. An edit is a few numbers.
MAX_REQUEST_CHARACTERS = 10_000
# Requests of all services that may wait for their answers. More are told so at once.
MOST_WAITING = 8
BUSY = f"busy: {MOST_WAITING} requests wait for their answers; try again"
# DDS keeps so many requests until the node has looked at them; more are lost without an answer.
REQUEST_DEPTH = 1000

Text = Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]


class Query(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question in words; see `client.questions`."""

    question: Text


class GoalNear(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An object, by id or class, and where to stand; see `client.goals`.

    `publish` false: the pose is only an answer.
    """

    object: int | Text
    distance_m: float = 1.0
    radius_m: float = Robot.radius_m
    height_m: float = Robot.height_m
    towards: Point | None = None
    publish: bool = True


class LookNext(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The robot, and where it is (absent = where the newest view was taken); see
    `client.next_view`.

    `publish` false: the pose is only an answer.
    """

    radius_m: float = Robot.radius_m
    height_m: float = Robot.height_m
    start: Point | None = None
    publish: bool = True


class Explain(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An object, by id or class, and for a pair a second one; or a class and a place."""

    object: int | Text
    other: int | Text | None = None


class Load(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A map file, absolute or relative to the working folder of the node."""

    path: Text


# Answers a request in the graph's thread: a text, or what else makes the text, in another thread.
_Answer = Callable[[Any], "str | Callable[[], str]"]


class GraphServices:
    """Answers requests: edits and files in the graph's thread, between two frames.

    A question takes the graph of its moment there. It is answered in a thread of its own, so that
    frames do not wait. A request that cannot be answered changes nothing. It is counted as
    ``invalid_request``, and the answer says why.

    Args:
        node: has the services.
        graph: its graph.
    """

    def __init__(self, node: StageNode, graph: GraphKeeper) -> None:
        self._node = node
        self._graph = graph
        self._publish_goal = node.create_publisher(PoseStamped, GOAL_TOPIC, reliable(1)).publish
        # What was seen of the graph of a builder, also by views that it has forgotten.
        self._seen: tuple[GraphBuilder | None, SeenCells] = (None, SeenCells(DEFAULT_UP))
        self._waiting = 0
        # In their group, no subscription would be served while an answer is awaited.
        self._group = ReentrantCallbackGroup()
        self._questions: Worker[Callable[[], None]] = Worker(
            "questions", lambda job: job(), size=MOST_WAITING, on_overrun=lambda job: None
        )
        services: Sequence[tuple[str, Any, _Answer]] = (
            ("query", Query, self._query),
            ("goal_near", GoalNear, self._goal_near),
            ("next_view", LookNext, self._next_view),
            ("explain", Explain, self._explain),
            ("load", Load, self._load),
            ("set_label", SetLabel, self._edit),
            ("merge", MergeNodes, self._edit),
            ("split", SplitNode, self._edit),
            ("delete", DeleteNode, self._edit),
            ("name_room", NameRoom, self._edit),
        )
        for name, kind, answer in services:
            self._serve(name, AddDiagnostics, partial(self._parsed, kind, answer))
        self._serve("save", Trigger, lambda text: self._save())
        self._serve("clear", Trigger, lambda text: self._clear())
        self._serve("undo", Trigger, lambda text: self._edit(Undo()))
        self._serve("changes", Trigger, lambda text: self._changes())

    def close(self) -> None:
        """End the thread of the questions."""
        self._questions.stop()

    def _serve(self, name: str, kind: Any, answer: _Answer) -> None:
        async def call(request: Any, response: Any) -> Any:
            if self._waiting >= MOST_WAITING:
                self._node.drop("busy", f"{name}: {BUSY}")
                response.success, response.message = False, BUSY
                return response
            done = Future()
            text = getattr(request, "load_namespace", "")
            self._waiting += 1  # only the executor's thread counts
            try:
                self._graph.submit(
                    lambda: self._answer(name, partial(answer, text), done),
                    lambda: self._refuse_busy(name, done),
                )
                response.success, response.message = await done
            finally:
                self._waiting -= 1
            return response

        qos = reliable(REQUEST_DEPTH)
        self._node.create_service(
            kind, f"~/{name}", call, qos_profile=qos, callback_group=self._group
        )

    def _answer(self, name: str, answer: Any, done: Future) -> None:
        """Call `answer`; a text is the answer, a function is called in the questions' thread."""
        result: tuple[bool, str] | None = (False, "internal error: see /diagnostics")
        with self._node.refusing():
            try:
                said = answer()
            except (DeWorldSGError, OSError) as error:
                self._node.drop("invalid_request", f"{name}: {error}")
                result = (False, str(error))
            else:
                result = None if callable(said) else (True, said)
                if callable(said):
                    self._questions.submit(partial(self._answer, name, said, done))
        if result is not None:
            self._done(done, result)

    def _refuse_busy(self, name: str, done: Future) -> None:
        self._node.drop("busy", f"{name}: too many messages wait")
        self._done(done, (False, "too many messages wait: try again"))

    def _done(self, done: Future, result: tuple[bool, str]) -> None:
        done.set_result(result)
        if self._node.executor is not None:
            self._node.executor.wake()

    # The methods below run in the graph's thread.

    def _parsed(self, kind: Any, answer: _Answer, text: str) -> str | Callable[[], str]:
        if len(text) > MAX_REQUEST_CHARACTERS:
            raise RefusedInput(
                "invalid_request",
                f"request of {len(text)} characters: expected at most {MAX_REQUEST_CHARACTERS}",
            )
        try:
            values = parse_json(text.encode(), dict[str, Any])
            session = values.pop("session", None)
            request = msgspec.convert(values, kind)
        except ValueError as error:
            fields = ", ".join(field.name for field in msgspec.structs.fields(kind))
            raise RefusedInput(
                "invalid_request", f"request {text[:80]!r}: {error}; expected JSON with {fields}"
            ) from error
        if session not in (None, self._graph.session):
            raise RefusedInput(
                "other_session",
                f"request of session {str(session)[:80]!r}: the graph is of session "
                f"'{self._graph.session}' now, where an id may be that of another object; read the "
                "graph again",
            )
        return answer(request)

    @property
    def _builder(self) -> GraphBuilder:
        if self._graph.builder is None:
            raise RefusedInput("invalid_request", "no graph yet: no local graph has arrived")
        return self._graph.builder

    def _asked(self) -> SceneGraph:
        builder = self._builder
        return SceneGraph(builder.full(), builder.frames.all(builder.graph))

    def _query(self, request: Query) -> Callable[[], str]:
        graph = self._asked()
        return lambda: _json(ask(graph, request.question).to_dict())

    def _goal_near(self, request: GoalNear) -> Callable[[], str]:
        graph, space = self._asked(), copy(self._builder.space)

        def answer() -> str:
            x, y, z = request.towards or (0.0, 0.0, 0.0)
            towards = None if request.towards is None else (x, y, z)
            robot = Robot(request.radius_m, request.height_m)
            goal: Goal = graph.goal_near(
                request.object, request.distance_m, robot=robot, towards=towards, space=space
            )
            if request.publish:
                self._publish_goal(goal.pose_stamped())
            return _json(goal.to_dict())

        return answer

    def _next_view(self, request: LookNext) -> Callable[[], str]:
        graph, builder = self._asked(), self._builder
        graph.space = copy(builder.space)
        robot = Robot(request.radius_m, request.height_m)
        T = builder.T_graph_poses
        camera = (T[:3, :3] @ builder.trail.camera_world + T[:3, 3]).tolist()
        x, y, z = camera if request.start is None else request.start

        def answer() -> str:
            if self._seen[0] is not builder or not self._seen[1].fits(graph.up):
                self._seen = builder, SeenCells(graph.up)
            has_views = graph.space is not None and len(graph.space) > 0
            start = (x, y, z) if has_views or request.start is not None else None
            found = graph.next_view(robot=robot, start=start, cells=self._seen[1])
            if found is None:
                return _json({"pose": None, "reason": NOTHING})
            if request.publish:
                self._publish_goal(found.pose_stamped())
            return _json(found.to_dict())

        return answer

    def _explain(self, request: Explain) -> str:
        what = request.object if request.other is None else (request.object, request.other)
        graph = self._asked()
        graph.space = self._builder.space
        return _json(graph.explain(what).to_dict())

    def _changes(self) -> Callable[[], str]:
        returning = self._graph.returning
        if returning is None or returning.waits:
            raise RefusedInput(
                "invalid_request",
                "there is no map in which the graph was found: is relocalise true?"
                if returning is None
                else f"to be found in the map {returning.status}",
            )
        graph = SceneGraph(self._builder.full())
        return lambda: _json(returning.changes(graph).to_dict())

    def _edit(self, request: GraphEdit) -> str:
        returning = self._graph.returning
        if returning is not None and returning.waits:
            raise RefusedInput(
                "invalid_request",
                "the graph is not yet found in its map, and what is edited now would be lost; try "
                "again when it is",
            )
        reply = self._builder.edit(request)
        self._graph.changed()
        return _json(reply)

    def _save(self) -> str:
        saved, said = self._graph.files.save(self._builder)
        if not saved:
            raise RefusedInput("invalid_request", said)
        return said

    def _load(self, request: Load) -> str:
        builder = read_map(self._node.parameters, Path(request.path))
        present = self._graph.builder
        # An empty graph, as after `clear`, has no names to keep.
        names = present.graph.vocabulary if present is not None and len(present.graph) else None
        if names is not None and names.predicates != builder.graph.vocabulary.predicates:
            raise RefusedInput(
                "invalid_request",
                f"map {request.path} has other predicates than the present graph: expected the "
                "same ones",
            )
        self._graph.replace(builder)
        return f"{request.path}: {builder.confirmed} nodes in frame '{builder.graph.frame_id}'"

    def _clear(self) -> str:
        graph = self._builder.graph
        self._graph.replace(GraphBuilder(self._node.parameters, graph.vocabulary, graph.frame_id))
        return f"{len(graph)} nodes are cleared"


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
