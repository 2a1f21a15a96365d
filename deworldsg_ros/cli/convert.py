"""`deworldsg convert`: convert a folder or bag to one MCAP file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TaskID

from deworldsg_ros.cli.outputs import print_drops
from deworldsg_ros.cli.progress import frame_progress
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.source import RawRoleMessage, Source
from deworldsg_ros.recordings.writer import check_output, write_mcap
from deworldsg_ros.words import counted


def convert_recording(
    kind: str,
    path: Path,
    output: Path,
    *,
    topics: TopicChoice,
    options: DatasetOptions,
    console: Console,
) -> None:
    """Write a recording as an MCAP file; raises RecordingError."""
    check_output(output)
    source = open_source(path, kind=kind, topics=topics, options=options)
    try:
        with frame_progress(console) as progress:
            task = progress.add_task("converting", total=source.frame_count, note="")
            count = write_mcap(_counted(source, progress, task), output)
            progress.update(task, total=progress.tasks[0].completed)
    finally:
        source.close()
    print_drops(console, source.losses, {"recording": source.drops}, {})
    size_mb = output.stat().st_size / 1e6
    console.print(
        f"{output}: {counted(count, 'message')}, {size_mb:.1f} MB", highlight=False, soft_wrap=True
    )


def _counted(source: Source, progress: Progress, task: TaskID) -> Iterator[RawRoleMessage]:
    for message in source.raw_messages():
        yield message
        if message.role is Role.RGB:
            progress.advance(task)
