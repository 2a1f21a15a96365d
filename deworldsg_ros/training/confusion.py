"""A confusion matrix as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deworldsg_ros.files import write_atomically
from deworldsg_ros.scene.arrays import Int64

# Size of the picture per predicate, and of the margin for the names.
INCHES_PER_PREDICATE = 0.45
MARGIN_INCHES = 2.0


@rc_context({"text.parse_math": False})  # a name may contain $
def write_confusion(path: Path, confusion: Int64, names: Sequence[str]) -> None:
    """Write the confusion matrix as PNG; only predicates that occur are shown.

    Args:
        path: the file to write.
        confusion: (R, R) counts, rows = true predicate, columns = predicted predicate.
        names: R names.
    """
    shown = np.flatnonzero(confusion.sum(axis=0) + confusion.sum(axis=1))
    counts = confusion[np.ix_(shown, shown)]
    labels = [names[index] for index in shown.tolist()]
    fractions = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = MARGIN_INCHES + INCHES_PER_PREDICATE * len(labels)
    figure = Figure(figsize=(side, side), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if labels:
        axes.imshow(fractions, cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(labels)), labels, rotation=90)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_xlabel("predicted")
    axes.set_ylabel("true")
    for row, column in np.argwhere(counts).tolist():
        colour = "white" if fractions[row, column] > 0.5 else "black"
        axes.text(column, row, str(counts[row, column]), ha="center", va="center", color=colour)
    write_atomically(path, lambda file: figure.savefig(file, format="png"))
