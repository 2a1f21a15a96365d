"""An MCP server on stdio, so that an LLM agent can ask a robot's graph. Offline, without a key."""

from __future__ import annotations

import functools
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from pathlib import Path
from typing import Any

from deworldsg_ros import __version__
from deworldsg_ros.base.words import whole_number
from deworldsg_ros.client.explain import place_of
from deworldsg_ros.client.goals import Robot
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.next_view import NOTHING
from deworldsg_ros.client.objects import SURE, SceneObject
from deworldsg_ros.client.questions import ask
from deworldsg_ros.client.removal import supports_of
from deworldsg_ros.graph.graph_files import GRAPH_FILE
from deworldsg_ros.scene.errors import ClientError, DeWorldSGError, RefusedInput
from deworldsg_ros.scene.limits import MAX_SECONDS

# --- The tools of the MCP server: questions with plain arguments, answers as plain values.

# Graphs that are remembered for `what_changed_since`.
MOST_GRAPHS = 256
# Objects and relations of one answer; an agent reads all of them.
MOST_ANSWERS = 50
# Places that `where_is` tells of one question.
MOST_OTHERS = 4
# A question is answered in this time, or with an error that says so. So many run at the same time:
# one that takes too long goes on until it ends.
LIMIT_S, MOST_AT_ONCE = 20.0, 8
# An object: its id, as a number or as text such as "#12", or its class.
Named = int | str


class GraphTools:
    """Answers questions about the newest graph, and remembers earlier graphs.

    Args:
        newest: returns the newest graph; called before each answer.
        client: a `SceneGraphClient`, which knows walls; None = the graph is of a file.
    """

    def __init__(self, newest: Callable[[], SceneGraph], client: Any = None) -> None:
        self._newest = newest
        self._client = client
        self._known: deque[SceneGraph] = deque(maxlen=MOST_GRAPHS)
        self._lock = threading.Lock()  # the server answers each question in a thread of its own

    def list_objects(
        self, label: str = "", min_probability: float = 0.0, limit: int = MOST_ANSWERS
    ) -> dict[str, Any]:
        """List the objects of the scene, the most probable first.

        Args:
            label: only this class, e.g. "cup"; empty = all classes.
            min_probability: only objects that exist and are of their class with this probability.
            limit: greatest number of objects in the answer.
        """
        graph = self._graph()
        found = graph.objects(label or None, min_probability=min_probability or None)
        return {
            **_about(graph),
            "classes": graph.labels,
            "count": len(found),
            "objects": [_short(item) for item in found[: max(limit, 0)]],
        }

    def list_relations(
        self,
        subject: Named = "",
        predicate: str = "",
        object: Named = "",
        limit: int = MOST_ANSWERS,
    ) -> dict[str, Any]:
        """List the relations between objects, e.g. every cup (subject) on (predicate) a table.

        Those first that are most probably true as their `text` says them: `triplet_probability`.

        Args:
            subject: class or id of the subject; empty = any.
            predicate: e.g. "on", "in", "near"; empty = any.
            object: class or id of the object; empty = any.
            limit: greatest number of relations in the answer.
        """
        graph = self._graph()
        found = graph.relations(_which(subject), predicate or None, _which(object))
        found.sort(key=lambda relation: -relation.triplet_probability)
        return {
            **_about(graph),
            "count": len(found),
            "relations": [
                {"text": relation.text, **relation.to_dict(), "evidence": relation.evidence}
                for relation in found[: max(limit, 0)]
            ],
        }

    def list_rooms(self) -> dict[str, Any]:
        """List the rooms: kind with its probability, storey, area, which are next to which by a
        doorway, and the ids of the objects in each with the probability that they are in it.
        """
        graph = self._graph()
        storeys_m = graph.message.storeys_m
        return {
            **_about(graph),
            "storeys_m": storeys_m if isinstance(storeys_m, list) else [],
            "rooms": [room.to_dict() for room in graph.rooms],
        }

    def find(self, question: str) -> dict[str, Any]:
        """Find objects by a pattern. Every answer has odds, evidence, and whether it is sure.

        Args:
            question: e.g. "cup on dining table", "chair within 0.5 m of table and near window",
                "anything near (1, 2, 0.5) within 1 m", "how many cups", "largest plant",
                "is the bear on the sofa", "what colour is the cup", "the red cup", "cup in the
                kitchen", "rooms next to the hall", "which room is the cup in". `notes` tell how
                the name of a class was taken. "like something to drink from" finds what looks like
                a text in any words, if the graph has embeddings.
        """
        graph = self._graph()
        return {**_about(graph), **ask(graph, question).to_dict()}

    def get_object_context(self, object: Named) -> dict[str, Any]:
        """Tell everything about one object: class, place, size, relations, neighbours, evidence.

        Args:
            object: id, or class; of a class, the most probable object. Or a place, as in "chair
                near (1.6, -0.5)": what is known of a chair there.
        """
        graph = self._graph()
        which = _which(object)
        if which is None or (
            isinstance(which, str)
            and (place_of(which, graph.up) is not None or not graph.objects(which))
        ):
            return {**_about(graph), "explanation": str(graph.explain(object))}
        item = graph.one(which)
        return {
            **_about(graph),
            "object": item.to_dict(),
            "rooms": _rooms(graph, item),
            "relations": [relation.to_dict() for relation in graph.relations_of(item)],
            "neighbours": [
                {"id": other.id, "label": other.label, "gap_m": round(gap, 3)}
                for other, gap in graph.neighbours(item)[:MOST_ANSWERS]
            ],
            "explanation": str(graph.explain(item)),
        }

    def where_is(self, object: Named) -> dict[str, Any]:
        """Tell where an object is: place, room, what it rests on, when it was seen, how sure.

        Example: where_is(object="red cup on the table").

        Args:
            object: in words, as for `find`, or an id. `others` are further objects that fit, the
                most probable first; `found` is false if there is none, and `notes` say why.
        """
        graph = self._graph()
        which = _which(object)
        if which is None:
            raise ClientError("object is empty: expected words or an id")
        if isinstance(which, int):
            ranked, notes = [(graph[which], graph[which].probability)], tuple[str, ...]()
        else:
            answers = ask(graph, which)
            ranked = [(one.item, one.probability) for one in answers.found[:MOST_OTHERS]]
            notes = answers.notes
        places = [
            {
                **_short(item),
                "probability": round(chance, 3),
                "sure": chance >= SURE,
                "rooms": _rooms(graph, item),
                "rests_on": [
                    {"id": other, "label": graph[other].label, "probability": round(share, 3)}
                    for other, (share, _) in supports_of(graph, item).items()
                ],
                "last_seen_s": item.last_seen_ns / 1e9,
                "seen_seconds_ago": (graph.stamp_ns - item.last_seen_ns) / 1e9,
            }
            for item, chance in ranked
        ]
        answer = {**_about(graph), "found": bool(places), "notes": list(notes)}
        return {**answer, "object": places[0], "others": places[1:]} if places else answer

    def if_removed(self, object: Named, clear: bool = False) -> dict[str, Any]:
        """Tell what falls or moves if an object is taken, and what to take before it.

        Example: if_removed(object="pan"). `moves` has the odds of each object, `safe` whether it
        can be taken now, and `steps` the order in which everything can be taken, the object last.

        Args:
            object: id, or class.
            clear: the steps take all that rests on the object, e.g. a shelf, and leave it there.
        """
        graph = self._graph()
        item = graph.one(_named(object))
        order = graph.order_to_clear(item) if clear else graph.order_to_take(item)
        steps = [step.to_dict() for step in order.steps]
        removal = graph.if_removed(item)
        return {
            **_about(graph),
            **removal.to_dict(),
            "steps": steps,
            "steps_safe": order.is_safe,
            "lines": removal.lines,
        }

    def what_changed_since(
        self, seconds_ago: float = 60.0, since_s: float | None = None
    ) -> dict[str, Any]:
        """Tell which objects were added, went, moved or were renamed since a time.

        Example: what_changed_since(seconds_ago=600). `times` says when, one sentence a change.

        Args:
            seconds_ago: before the newest frame of the graph.
            since_s: a stamp in seconds, such as `stamp_s` of an earlier answer, in its place.
        """
        graph = self._graph()
        ago_s = seconds_ago if since_s is None else graph.stamp_ns / 1e9 - since_s
        if not abs(ago_s) <= MAX_SECONDS:
            name = "seconds_ago" if since_s is None else "since_s"
            value = seconds_ago if since_s is None else since_s
            raise ClientError(f"{name} {value:g}: expected at most {MAX_SECONDS}")
        start_ns = graph.stamp_ns - round(ago_s * 1e9)
        with self._lock:
            known = list(self._known)
        earlier = [item for item in known if item.stamp_ns <= start_ns]
        before = earlier[-1] if earlier else known[0]
        answer: dict[str, Any] = {
            **_about(graph),
            "compared_with_s": before.stamp_ns / 1e9,
            "first_seen_since": [_short(item) for item in graph if item.first_seen_ns >= start_ns],
        }
        if before is not graph:
            changes = graph.changes_since(before)
            answer.update(changes.to_dict(), lines=changes.lines, times=changes.dated_lines)
        if not earlier:
            answer["note"] = (
                "no graph of that time is known: the comparison starts when this server started"
            )
        return answer

    def go_to_goal(
        self,
        object: Named,
        distance_m: float = 1.0,
        radius_m: float = Robot.radius_m,
        height_m: float = Robot.height_m,
    ) -> dict[str, Any]:
        """Give the pose on the floor to go to, from which an object is in view.

        Example: go_to_goal(object="cup", distance_m=0.8). `header` and `pose` are those of a
        geometry_msgs/PoseStamped: send them to Nav2 as the goal; this tool drives no robot.
        `seen_free` is the share of the robot's volume there that was seen as free; null = walls are
        not known.

        Args:
            object: id, or class.
            distance_m: from the box of the object, metres.
            radius_m: half of the robot's width.
            height_m: of the robot; what is higher is not in its way.
        """
        which = _named(object)
        robot = Robot(radius_m, height_m)
        if self._client is not None:
            return dict(self._client.goal_near(which, distance_m, robot))
        return self._graph().goal_near(which, distance_m, robot=robot).to_dict()

    def next_view(
        self, radius_m: float = Robot.radius_m, height_m: float = Robot.height_m
    ) -> dict[str, Any]:
        """Give the pose on the floor from which the camera is expected to learn most, with the
        reason in words, e.g. "cup #3 may be a bowl" or "to see behind couch #5". Go there, then ask
        again. `pose` null = nothing is worth a look. Example: {"radius_m": 0.25}. Takes less than
        a second.

        Args:
            radius_m: half of the robot's width, e.g. 0.25.
            height_m: of the robot; what is higher is not in its way.
        """
        robot = Robot(radius_m, height_m)
        if self._client is not None:
            return dict(self._client.next_view(robot))
        found = self._graph().next_view(robot=robot)
        return {"pose": None, "reason": NOTHING} if found is None else found.to_dict()

    def _graph(self) -> SceneGraph:
        with self._lock:
            graph = self._newest()
            if not self._known or self._known[-1] is not graph:
                self._known.append(graph)
            return graph


class EditTools:
    """The edits of an operator, as tools.

    Args:
        client: a `SceneGraphClient`.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def __iter__(self) -> Iterator[Callable[..., dict[str, Any]]]:
        return iter((self.set_label, self.merge, self.split, self.delete, self.undo))

    def set_label(self, object: int, label: str) -> dict[str, Any]:
        """Correct the class of an object. It stays for later frames; undo takes it back.

        Args:
            object: id.
            label: e.g. "cup".
        """
        return dict(self._client.set_label(object, label))

    def merge(self, object: int, other: int) -> dict[str, Any]:
        """Say that two objects are one. The answer has the id of the new object.

        Args:
            object: id.
            other: id.
        """
        return dict(self._client.merge(object, other))

    def split(self, object: int) -> dict[str, Any]:
        """Say that an object is two, one beside the other along its longest axis.

        Args:
            object: id.
        """
        return dict(self._client.split(object))

    def delete(self, object: int) -> dict[str, Any]:
        """Say that there is no such object. It does not come back from its place and class.

        Args:
            object: id.
        """
        return dict(self._client.delete(object))

    def undo(self) -> dict[str, Any]:
        """Undo the newest edit that was not undone yet, of any user."""
        return dict(self._client.undo())


class WatchedFile:
    """The graph of a file, which is read again after it was written again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen = self._written()
        self._graph = SceneGraph.load(path)

    def __call__(self) -> SceneGraph:
        """The newest readable graph of the file."""
        written = self._written()
        if written not in (None, self._seen):
            self._seen = written
            # Something else was written there: the last graph is still the newest one.
            with suppress(RefusedInput):
                self._graph = SceneGraph.load(self._path)
        return self._graph

    def _written(self) -> tuple[int, int] | None:
        """Time of the last write, and the size; None = there is no file."""
        file = self._path / GRAPH_FILE if self._path.is_dir() else self._path
        try:
            status = file.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size


def _about(graph: SceneGraph) -> dict[str, Any]:
    return {"frame_id": graph.frame_id, "stamp_s": graph.stamp_ns / 1e9, "up": list(graph.up)}


def _short(item: SceneObject) -> dict[str, Any]:
    names = ("id", "label", "probability", "sure", "position_m", "size_m", "colour", "observations")
    values = item.to_dict()
    guesses = {} if item.is_named else {"named": False, "guesses": values["classes"]}
    return {name: values[name] for name in names} | guesses


def _rooms(graph: SceneGraph, item: SceneObject) -> list[dict[str, Any]]:
    return [
        {"id": room.id, "label": room.label, "probability": share}
        for room, share in graph.rooms.of(item.id)
    ]


def _named(text: Named) -> int | str:
    which = _which(text)
    if which is None:
        raise ClientError("object is empty: expected an id or a class")
    return which


def _which(text: Named) -> int | str | None:
    text = str(text).strip().removeprefix("#")
    number = whole_number(text)
    return (text or None) if number is None else number


# --- An MCP server on stdio, so that an LLM agent can ask a robot's graph. Offline, without a
# key.

INSTRUCTIONS = (
    "A live 3D scene graph of a robot's surroundings: objects with positions and sizes in metres, "
    "and relations between them. Every answer has a probability; `sure` is false below odds of "
    "2 : 1, and then say that you are not sure. Positions are in the frame `frame_id`; `up` points "
    "against gravity. Every tool answers within 20 s, or says that it does not. Start with "
    "where_is, list_objects or find."
)


def within(
    limit_s: float, places: threading.Semaphore, call: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """The answer of a call, within a time.

    Args:
        limit_s: seconds.
        places: one is taken while the call runs, also if its answer is not waited for any more.
        call: to make.

    Raises:
        ClientError: if the call takes longer, or all places are taken.
    """
    if not places.acquire(timeout=limit_s):
        raise ClientError("busy: earlier questions still run; ask again later")
    answer: Future[dict[str, Any]] = Future()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:  # it is raised where the answer is awaited
            answer.set_exception(error)
        finally:
            places.release()

    threading.Thread(target=run, daemon=True).start()
    try:
        return answer.result(limit_s)
    except FutureTimeout as error:
        raise ClientError(
            f"no answer within {limit_s:g} s: ask for fewer objects, or for one by its id"
        ) from error


def make_server(newest: Callable[[], SceneGraph], client: Any = None, edits: bool = False) -> Any:
    """The server with its tools.

    Args:
        newest: returns the newest graph.
        client: a `SceneGraphClient` with this graph; None = the graph is of a file.
        edits: the agent may edit the graph of the client.

    Raises:
        ClientError: without the package mcp.
    """
    try:
        from mcp.server import MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
    except ImportError as error:
        raise ClientError(
            "the MCP server needs the package mcp, version 2: pip install 'deworldsg_ros[mcp]'"
        ) from error

    places = threading.BoundedSemaphore(MOST_AT_ONCE)
    edit_tools = list(EditTools(client)) if edits else []

    def reporting(function: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> dict[str, Any]:
            try:
                asked = functools.partial(function, *arguments, **named)
                # An edit has to end, and has a limit of its own.
                return asked() if function in edit_tools else within(LIMIT_S, places, asked)
            except DeWorldSGError as error:
                raise ToolError(str(error)) from error
            except Exception as error:  # an agent would be told nothing but that it failed
                raise ToolError(f"{function.__name__} failed: {error!r}") from error

        return call

    tools = GraphTools(newest, client)
    functions: list[Callable[..., dict[str, Any]]] = [
        tools.list_objects,
        tools.list_relations,
        tools.list_rooms,
        tools.find,
        tools.get_object_context,
        tools.where_is,
        tools.if_removed,
        tools.what_changed_since,
        tools.go_to_goal,
        tools.next_view,
        *edit_tools,
    ]
    server = MCPServer(
        "deworldsg", version=__version__, instructions=INSTRUCTIONS, log_level="WARNING"
    )
    for function in functions:
        server.tool()(reporting(function))
    return server
