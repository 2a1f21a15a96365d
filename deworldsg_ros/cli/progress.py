"""The progress bar and the spinner of all commands."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.status import Status
from rich.text import Text


class _RateColumn(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:5.1f}/s" if speed else "     –", style="progress.data.speed")


def working(console: Console, text: str) -> Status:
    """A spinner with a text; without a terminal, the text alone."""
    if not console.is_terminal:
        console.print(text, highlight=False, soft_wrap=True)
    return console.status(text)


def say_instead(console: Console, status: Status, text: str) -> None:
    """Give a spinner another text; without a terminal, print it."""
    if console.is_terminal:
        status.update(text)
    else:
        console.print(text, highlight=False, soft_wrap=True)


def frame_progress(console: Console) -> Progress:
    """Progress over frames: bar, count, frames per second, time, and a field `note`."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=console,
    )
