"""PNG plots: recall by class, confusion, reliability of edges, recall over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deworldsg_ros.evaluation.measures.calibration import (
    Calibrated,
    calibration_error,
    reliability,
)
from deworldsg_ros.evaluation.protocol.scoring import Count
from deworldsg_ros.evaluation.reports.csv_latex import class_items
from deworldsg_ros.evaluation.runner import Checkpoint
from deworldsg_ros.files import write_atomically

DPI = 130
RIGHT, ALL = "#2f6f8f", "#d5dde3"
COLOURS = ("#2f6f8f", "#b8562f", "#5c8a3a")
MAX_CLASSES = 40
# The name of a class may contain $.
_plain_text = rc_context({"text.parse_math": False})


@_plain_text
def plot_classes(path: Path, counts: Mapping[str, Count], title: str) -> None:
    """Bars of items and of right items by class, most items first."""
    items = class_items(counts)[:MAX_CLASSES]
    figure, axes = _figure(10.0, 1.2 + 0.24 * max(len(items), 3))
    indices = np.arange(len(items))
    axes.barh(indices, [count.total for _, count in items], color=ALL, label="annotated")
    axes.barh(indices, [count.hits for _, count in items], color=RIGHT, label="right")
    for index, (_, count) in enumerate(items):
        axes.text(count.total, index, f" {100 * count.recall:.0f} %", va="center", fontsize=8)
    axes.set_yticks(indices, [name for name, _ in items], fontsize=9)
    axes.invert_yaxis()
    axes.margins(x=0.08)
    axes.set_xlabel("items")
    axes.set_title(title)
    if items:
        axes.legend(loc="lower right", frameon=False)
    _save(figure, path)


@_plain_text
def plot_confusion(path: Path, pairs: Sequence[tuple[str, str]], title: str) -> None:
    """Confusion matrix of annotated and predicted classes of nodes; each row sums to one."""
    counts = Counter(pairs)
    rows = [name for name, _ in Counter(pair[0] for pair in pairs).most_common(MAX_CLASSES)]
    others = Counter(pair[1] for pair in pairs if pair[1] not in rows)
    columns = rows + [name for name, _ in others.most_common(max(0, MAX_CLASSES - len(rows)))]
    table = np.array([[counts[row, column] for column in columns] for row in rows], float)
    table = table.reshape(len(rows), len(columns))
    fractions = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    side = 2.5 + 0.24 * max(len(columns), 4)
    figure, axes = _figure(side, 2.0 + 0.24 * max(len(rows), 4))
    if len(rows):
        image = axes.imshow(fractions, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        figure.colorbar(image, ax=axes, fraction=0.035, label="fraction of the nodes of a row")
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_xlabel("predicted class of the node")
    axes.set_ylabel("annotated class of the object")
    axes.set_title(title)
    _save(figure, path)


@_plain_text
def plot_reliability(path: Path, beliefs: Mapping[str, Sequence[Calibrated]], title: str) -> None:
    """Right part of the edges over their probability, a line per name; on the diagonal if honest.

    The number beside a point is that of the edges in its interval.
    """
    figure, axes = _figure(6.4, 6.0)
    axes.plot([0, 1], [0, 1], color=ALL, linewidth=1)
    # Numbers of the first line are above its points, those of the second below.
    for (name, items), colour, offset in zip(beliefs.items(), COLOURS, ((-4, 6), (4, -10))):
        bins = reliability(items)
        error = f"ECE {100 * calibration_error(items):.1f} %" if items else "no edge"
        axes.plot(
            [item.probability for item in bins],
            [item.right for item in bins],
            color=colour,
            marker="o",
            markersize=4,
            label=f"{name}: {len(items)} edges, {error}",
        )
        for item in bins:
            axes.annotate(
                str(item.size),
                (item.probability, item.right),
                xytext=offset,
                textcoords="offset points",
                fontsize=7,
                color=colour,
            )
    axes.set_xlim(0, 1.04)
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlabel("probability of the edge")
    axes.set_ylabel("part of the edges that is right")
    axes.set_title(title)
    if beliefs:
        axes.legend(loc="upper left", frameon=False)
    _save(figure, path)


@_plain_text
def plot_over_time(path: Path, runs: Mapping[str, Sequence[Checkpoint]], title: str) -> None:
    """Recall of each scan over the time of the recording."""
    figure, axes = _figure(9.0, 5.0)
    kinds = ("object_recall", "predicate_recall", "relationship_recall")
    for run, checkpoints in enumerate(runs.values()):
        times_s = [item.stamp_s for item in checkpoints]
        for kind, colour in zip(kinds, COLOURS):
            axes.plot(
                times_s,
                [100 * getattr(item, kind) for item in checkpoints],
                color=colour,
                alpha=0.9 if len(runs) < 4 else 0.5,
                marker="o",
                markersize=3,
                linestyle=("-", "--", ":", "-.")[run % 4],
                label=kind.split("_")[0] + "s" if run == 0 else None,
            )
    axes.set_ylim(0, 103)
    axes.set_xlabel("time of the recording, s")
    axes.set_ylabel("recall at 1, %")
    axes.set_title(title)
    if runs:
        axes.legend(loc="lower right", frameon=False)
    _save(figure, path)


def _figure(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(figure: Figure, path: Path) -> None:
    # Without date and version: equal results give equal bytes.
    write_atomically(
        path, lambda file: figure.savefig(file, format="png", metadata={"Software": None})
    )
