"""The results of run and demo: files in the output folder, tables, and the doctor's findings."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.style import Style
from rich.table import Table
from rich.text import Text

from deworldsg_ros.base.files import check_writable, together, write_atomically
from deworldsg_ros.base.words import visible
from deworldsg_ros.checkpoints.catalogue import unused_detector
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SURE, Rooms, scene_object
from deworldsg_ros.config import Config, to_yaml
from deworldsg_ros.doctor import Finding, FrameSampler, Observations, find
from deworldsg_ros.graph.embeddings import embeddings_path
from deworldsg_ros.graph.graph_files import GRAPH_FILE
from deworldsg_ros.graph.provenance import SeenSpace, path_beside, space_path
from deworldsg_ros.recordings.bags.bag import BagSource
from deworldsg_ros.recordings.posing import PosedSource
from deworldsg_ros.recordings.recording import Recording
from deworldsg_ros.ros.health import REASONS, UNMATCHED_PREFIX
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import RgbdFrame, UpEstimator
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.view.colours import class_colours
from deworldsg_ros.wire import messages as wire

if TYPE_CHECKING:
    from deworldsg_ros.pipeline import FrameResult, Pipeline

# --- The results of run and demo: files in the output folder, and tables on the terminal.

PICTURE_FILE = "scene_graph.png"
PAGE_FILE = "scene_graph.html"
CONFIG_FILE = "config.yaml"
REPORT_FILE = "run.json"
FRAMES_FILE = path_beside(Path(GRAPH_FILE)).name
SPACE_FILE = space_path(Path(GRAPH_FILE)).name
EMBEDDINGS_FILE = embeddings_path(Path(GRAPH_FILE)).name
RESULTS = (
    *(CONFIG_FILE, GRAPH_FILE, PICTURE_FILE, PAGE_FILE, REPORT_FILE),
    *(FRAMES_FILE, SPACE_FILE, EMBEDDINGS_FILE),
)
# Rows of each printed table, to fit a screen; the page shows everything.
MOST_ROWS = 25
# Side of the photos in the picture.
PHOTO_PX = 160
# Printed losses of a recording; run.json has all.
MOST_LOSSES = 5


def check_folder(out: Path) -> None:
    """Create the folder and test that it can be written; raises ConfigurationError."""
    with _refusing(out):
        check_writable(out / CONFIG_FILE)


@contextmanager
def writing(out: Path, config: Config) -> Iterator[Path]:
    """A folder for the results, with the effective configuration.

    All results are put into `out` at the end, together. After an error or a kill, the results of
    the run before are still there.

    Raises:
        ConfigurationError: if something cannot be written.
    """
    with _refusing(out), together(out, RESULTS) as staged:
        write_atomically(staged / CONFIG_FILE, to_yaml(config))
        yield staged


@contextmanager
def _refusing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigurationError(
            f"--out {out}: cannot be written ({reason}); give a writable folder"
        ) from error


def show_graph(
    out: Path,
    graph: wire.SceneGraphMessage,
    console: Console,
    T_world_cameras: Sequence[Float64],
    world_up: str,
    frames: Iterable[RgbdFrame] = (),
    space: SeenSpace | None = None,
) -> None:
    """Print the tables, draw the picture and write the page.

    Args:
        out: folder of picture and page.
        graph: the graph, with surface points.
        console: terminal.
        T_world_cameras: poses (4, 4) of the processed frames.
        world_up: `inputs.world_up`.
        frames: some frames of the recording, for photos of the objects.
        space: what the camera saw of the room; None = the page has no surface of it.
    """
    # Imported here because matplotlib takes a second to load.
    from deworldsg_ros.view import page, picture

    up = UpEstimator(world_up)
    for T_world_camera in T_world_cameras:
        up.observe(T_world_camera)
    path_world = np.array([T[:3, 3] for T in T_world_cameras], np.float64).reshape(-1, 3)
    print_graph(console, graph)
    with console.status("drawing …"):
        picture.draw(
            graph,
            out / PICTURE_FILE,
            up_world=up.up_world(),
            camera_path_world=path_world,
            photos=picture.photos_of(graph, frames, PHOTO_PX),
        )
        page.write(
            graph,
            out / PAGE_FILE,
            up_world=up.up_world(),
            camera_path_world=path_world,
            space=space,
        )


def write_report(out: Path, report: Mapping[str, Any]) -> None:
    """Write run.json."""
    text = json.dumps(report, indent=2, ensure_ascii=False)
    write_atomically(out / REPORT_FILE, text + "\n")


def print_files(console: Console, out: Path) -> None:
    """Print the paths of the results."""
    console.print(Text(f"results in {visible(str(out))}:"), highlight=False, soft_wrap=True)
    for name, meaning in (
        (PAGE_FILE, "3D view, open it in a browser"),
        (PICTURE_FILE, "top view"),
        (GRAPH_FILE, "the graph, with surface points"),
        (FRAMES_FILE, "the frames that it comes from"),
        (SPACE_FILE, "the space that the camera saw as free"),
        (EMBEDDINGS_FILE, "what its objects look like, as vectors"),
        (CONFIG_FILE, "the effective configuration"),
        (REPORT_FILE, "frames, drops by reason, times"),
    ):
        if (out / name).exists():
            line = Text.assemble(f"  {visible(str(out / name))}  ", (meaning, "dim"))
            console.print(line, highlight=False, soft_wrap=True)


def print_drops(
    console: Console,
    losses: Sequence[str],
    drops: Mapping[str, Mapping[str, int]],
    reasons: Mapping[str, str],
) -> None:
    """Print losses and drops; unmatched images are in run.json only.

    Args:
        console: terminal.
        losses: damaged parts of the recording, in words.
        drops: counts by owner and reason.
        reasons: an example by reason.
    """
    shown = list(dict.fromkeys(losses))
    for loss in shown[:MOST_LOSSES]:
        print_noted(console, "lost:", loss)
    if len(shown) > MOST_LOSSES:
        print_noted(console, "lost:", f"… and {len(shown) - MOST_LOSSES} more")
    for owner, counts in drops.items():
        for reason, count in sorted(counts.items()):
            if reason.startswith(UNMATCHED_PREFIX):
                continue
            example = f" ({reasons[reason]})" if reason in reasons else ""
            print_noted(console, "left out", f"by {owner}: {count} {reason}{example}")


def print_noted(console: Console, note: str, text: str) -> None:
    """Print a line that begins with a yellow note. Its text comes from files: no markup in it."""
    line = Text.assemble((note, "yellow"), f" {visible(text)}")
    console.print(line, highlight=False, soft_wrap=True)


def print_part(console: Console, frames: int, images: int) -> None:
    """Say that the results are those of a part of a recording."""
    print_noted(console, "stopped:", f"the results are those of {frames} of {images} frames")


# --- The graph as two tables on the terminal: objects, and relations.

PROVENANCE_STYLES = {"visual": "", "prior": "yellow", "fused": "cyan"}


def print_graph(console: Console, graph: wire.SceneGraphMessage, most: int = MOST_ROWS) -> None:
    """Print the most observed objects and the most probable relations, at most `most` of each."""
    console.print(object_table(graph, most))
    console.print(relation_table(graph, most))
    if isinstance(graph.rooms, list) and graph.rooms:
        rooms = ", ".join(
            f"{room.name} of {room.area_m2:.0f} m²" + ("" if room.probability >= SURE else " (?)")
            for room in Rooms.of_message(graph.rooms)
        )
        console.print(Text(f"rooms: {visible(rooms)}"), highlight=False)


def object_table(graph: wire.SceneGraphMessage, most: int = MOST_ROWS) -> Table:
    """Objects, most observed first, with the sides of their boxes."""
    table = Table(
        title=_title("object", len(graph.nodes), most),
        caption=Text(
            "p: it exists and is that; an object without a name: it exists; "
            f"position in frame {graph.frame_id!r}; "
            "size: length, width and height; seen: number of frames"
        ),
    )
    table.add_column("object", no_wrap=True)
    table.add_column("p", justify="right")
    table.add_column("x, y, z (m)", justify="right", no_wrap=True)
    table.add_column("size (cm)", justify="right", no_wrap=True)
    table.add_column("seen", justify="right")
    colours = class_colours(node.label for node in graph.nodes)
    up = SceneGraph(graph).up
    for node in sorted(graph.nodes, key=lambda node: (-node.observations, node.id))[:most]:
        item = scene_object(node, graph.frame_id, up)
        table.add_row(
            _name(node.label, node.id, Style(color=colours[node.label])),
            _percent(item.probability),
            " ".join(f"{value:6.2f}" for value in item.position_m),
            " × ".join(item.size_words),
            str(node.observations),
        )
    return table


def relation_table(graph: wire.SceneGraphMessage, most: int = MOST_ROWS) -> Table:
    """Relations, those first that are most probably true as they are said."""
    found = SceneGraph(graph).relations()
    table = Table(
        title=_title("relation", len(found), most),
        caption="p: it holds, and both are what they are called",
    )
    for name in ("subject", "predicate", "object"):
        table.add_column(name, no_wrap=True)
    table.add_column("p", justify="right")
    table.add_column("provenance", no_wrap=True)
    table.add_column("seen", justify="right")
    found.sort(key=lambda item: (-item.triplet_probability, -item.observations))
    for item in found[:most]:
        table.add_row(
            _name(item.subject.label, item.subject.id),
            Text(visible(item.predicate), "bold"),
            _name(item.object.label, item.object.id),
            _percent(item.triplet_probability),
            Text(item.provenance, PROVENANCE_STYLES[item.provenance]),
            str(item.observations),
        )
    return table


def _title(noun: str, number: int, most: int) -> str:
    plural = noun if number == 1 else f"{noun}s"
    return f"{number} {plural}" + (f" (the first {most})" if number > most else "")


def _name(label: str, node_id: int, style: str | Style = "") -> Text:
    return Text.assemble((visible(label), style), (f" #{node_id}", "dim"))


def _percent(probability: float) -> str:
    return f"{100 * probability:.0f} %"


# --- Observations of a run for the doctor, and the output of its findings.


class RunObserver:
    """Notes each frame of a run and its result."""

    def __init__(self) -> None:
        self._sampler = FrameSampler()
        self._turns: Counter[int] = Counter()
        self._detections = 0

    def note(self, frame: RgbdFrame, result: FrameResult) -> None:
        """Note a processed frame."""
        self._sampler.add(frame)
        self._turns[result.perceived.turns] += 1
        self._detections += len(result.perceived.frame_graph)

    def findings(
        self, recording: Recording, pipeline: Pipeline, drops: Mapping[str, Mapping[str, int]]
    ) -> list[Finding]:
        """Findings about the run so far.

        Args:
            recording: of the frames.
            pipeline: that processed them.
            drops: counts by owner and reason.
        """
        from deworldsg_ros.perception.stage import Perception

        perception, builder = pipeline.perception, pipeline.builder
        unused, settings = unused_detector(pipeline.config.perception)
        graph = None if builder is None else pipeline.graph()
        reasons: Counter[str] = Counter()
        for counts in drops.values():
            reasons.update(counts)
        is_given = pipeline.config.inputs.world_up != "auto"
        source = recording.source
        if isinstance(source, PosedSource):
            source = source.original
        seen = Observations(
            headers=source.headers() if isinstance(source, BagSource) else {},
            images=recording.frame_count,
            frames=self._turns.total(),
            drops=reasons,
            examples=recording.reasons,
            remedies=REASONS,
            nodes=0 if graph is None else len(graph.nodes),
            hidden={} if builder is None else builder.hidden,
            detections=self._detections,
            classes=perception.vocabulary.classes if isinstance(perception, Perception) else (),
            sizes=() if graph is None else sizes_of(graph),
            turns=self._turns,
            up_world=() if graph is None or is_given else tuple(graph.up or ()),
            checks=self._sampler.checks(),
            unused_detector=unused,
            its_settings=settings,
        )
        return find(seen)


def sizes_of(graph: wire.SceneGraphMessage) -> tuple[tuple[str, float], ...]:
    """Label and longest side in metres of each node."""
    return tuple((node.label, max(node.box.size_m)) for node in graph.nodes if node.box)


def print_findings(console: Console, findings: Sequence[Finding]) -> None:
    """Print each finding as a paragraph of one line."""
    for finding in findings:
        print_noted(console, "note:" if finding.harmless else "check:", str(finding))


def as_report(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Findings for run.json."""
    return [asdict(finding) for finding in findings]


# --- The frames of a recording that photos of objects are cut from.

# Frames of a recording that are kept: 64 MB, and at least as many as a walk around a room needs.
MOST_BYTES, LEAST_FRAMES = 64 << 20, 8


class Album:
    """Keeps frames of a recording, evenly spaced, however long it is."""

    def __init__(self) -> None:
        self.frames: list[RgbdFrame] = []
        self._every = 1
        self._count = 0

    def add(self, frame: RgbdFrame) -> None:
        """Keep a frame, or not."""
        if self._count % self._every == 0:
            size = frame.rgb.nbytes + frame.depth_m.nbytes
            if len(self.frames) >= max(MOST_BYTES // size, LEAST_FRAMES):
                del self.frames[1::2]
                self._every *= 2
            if self._count % self._every == 0:
                self.frames.append(frame)
        self._count += 1
