"""`deworldsg info`: show the topics of a recording."""

from __future__ import annotations

from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from deworldsg_ros.cli.outputs import print_noted
from deworldsg_ros.recordings.bags.storage import RawBag
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.recording import detect_kind, open_source
from deworldsg_ros.words import counted, visible


def show_recording(
    path: Path, topics: TopicChoice, options: DatasetOptions, console: Console
) -> None:
    """Print the kind, the topics and their use, and the lost data; raises RecordingError.

    Args:
        path: of the recording.
        topics: topics of a bag that the user named.
        options: intrinsics that the user gave.
        console: terminal.
    """
    kind = detect_kind(path)
    used: dict[str, str] = {}
    problem = None
    losses: list[str] = []
    frames = 0
    try:
        source = open_source(path, kind=kind, topics=topics, options=options, need_poses=False)
    except RecordingError as error:
        if kind != "rosbag2":
            raise
        problem = str(error)
    else:
        used = {topic.name: role.value for role, topic in source.topics.items()}
        rows = [(topic.name, topic.msgtype, topic.count) for topic in source.topics.values()]
        frames, losses = source.frame_count, source.losses
        source.close()
    if kind == "rosbag2":
        bag = RawBag(path)
        rows = [(topic.name, topic.msgtype, topic.count) for topic in bag.topics]
        losses = bag.losses
        bag.close()
    console.print(
        f"{path}: {kind}, {counted(frames, 'RGB image')}", highlight=False, soft_wrap=True
    )
    table = Table(box=box.SIMPLE)
    table.add_column("topic" if kind == "rosbag2" else "files", overflow="fold")
    table.add_column("type", overflow="fold")
    table.add_column("messages", justify="right")
    table.add_column("used as")
    for name, msgtype, count in rows:
        kind_of = Text(visible(msgtype.split("/")[-1]))
        table.add_row(Text(visible(name)), kind_of, str(count), used.get(name, ""))
    console.print(table)
    if used and Role.POSE.value not in used.values():
        print_noted(
            console, "no poses:", "use run or demo with --odometry, or run with --poses FILE"
        )
    for loss in losses:
        print_noted(console, "lost:", loss)
    if problem:
        raise RecordingError(problem)
