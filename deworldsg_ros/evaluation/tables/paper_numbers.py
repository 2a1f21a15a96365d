"""Numbers printed in the tables of the paper, percent, for comparison.

Some numbers in the abstract and text of the paper differ: these are from its tables.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

COLUMNS = (
    "relationship_recall",
    "object_recall",
    "predicate_recall",
    "object_mean_recall",
    "predicate_mean_recall",
)


@dataclass(frozen=True)
class PrintedRow:
    """A row of a table of the paper.

    Attributes:
        title: title as printed.
        dataset: name of the data set.
        percents: numbers in the order of `COLUMNS`.
    """

    title: str
    dataset: str
    percents: tuple[float, float, float, float, float]

    def numbers(self) -> dict[str, float]:
        """Recalls by name, as fractions."""
        return {
            name: round(value / 100, 6) for name, value in zip(COLUMNS, self.percents, strict=True)
        }


def _rows(
    dataset: str, *rows: tuple[str, tuple[float, float, float, float, float]]
) -> list[PrintedRow]:
    return [PrintedRow(title, dataset, percents) for title, percents in rows]


MAIN_3DSSG = _rows(
    "3DSSG",
    ("IMP", (19.7, 49.5, 20.9, 34.7, 13.8)),
    ("VGfM", (19.6, 50.0, 20.4, 34.8, 11.0)),
    ("3DSSG", (12.9, 37.4, 22.0, 26.2, 14.4)),
    ("SGFN", (22.0, 51.6, 27.5, 37.7, 24.0)),
    ("Kim et al.", (9.1, 59.0, 7.1, 51.0, 8.0)),
    ("MonoSSG", (23.3, 53.8, 28.4, 43.8, 26.6)),
    ("FROSS", (27.9, 62.4, 33.0, 63.8, 18.0)),
    ("DeWorldSG", (50.2, 75.0, 57.3, 70.6, 36.0)),
)
POSE_REPLICA = _rows(
    "ReplicaSSG",
    ("FROSS", (22.3, 26.1, 27.8, 28.8, 20.4)),
    ("DeWorldSG", (38.2, 35.4, 45.3, 38.1, 27.3)),
    ("FROSS, estimated poses", (22.7, 25.8, 27.2, 27.7, 20.1)),
    ("DeWorldSG, estimated poses", (37.4, 33.8, 42.8, 37.6, 26.9)),
)
ABLATION_3DSSG = _rows(
    "3DSSG",
    ("(a) lifting only", (28.5, 63.4, 33.4, 64.3, 20.5)),
    ("(b) + masks", (40.3, 71.7, 46.7, 68.1, 26.3)),
    ("(c) + depth refinement", (47.8, 74.6, 52.9, 70.8, 30.1)),
    ("(d) + DINOv2", (49.5, 74.6, 56.6, 69.5, 33.7)),
    ("(e) + V-JEPA 2", (50.2, 75.0, 57.3, 70.6, 36.0)),
)
# Mean milliseconds per frame on ReplicaSSG, as printed; the parts add up to 108.58, not 108.53.
RUNTIME_DEVICE = "NVIDIA RTX A6000"
RUNTIME_MS = {
    "detection": 4.42,
    "relation_inference": 7.28,
    "masks": 25.26,
    "merging": 2.23,
    "relations": 69.39,
    "total": 108.53,
}


# The test split of ReplicaSSG. Other data sets have its layout, too.
REPLICA_TEST_SCANS = frozenset(
    ("apartment_1", "apartment_2", "office_1", "office_3", "office_4", "room_1", "room_2")
    + ("hotel_0", "frl_apartment_3", "frl_apartment_4", "frl_apartment_5")
)


def printed_rows(table: str, layout: str, scans: Collection[str]) -> list[PrintedRow]:
    """Rows of the paper for a table and data set; none if the paper has none.

    Args:
        table: name of the table.
        layout: layout of the data set.
        scans: the evaluated scans; those of another data set than ReplicaSSG have no printed rows.
    """
    if layout == "replica" and set(scans) == REPLICA_TEST_SCANS:
        rows = {"main": POSE_REPLICA[:2], "predictions": POSE_REPLICA, "pose": POSE_REPLICA}
        return rows.get(table, [])
    if layout == "3rscan":
        rows = {"main": MAIN_3DSSG, "predictions": MAIN_3DSSG, "ablation": ABLATION_3DSSG}
        return rows.get(table, [])
    return []
