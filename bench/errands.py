"""Errands in simulated homes (tools/errands): how many are fulfilled, and by other methods.

python -m bench --only errands
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from bench.figures import Figure, Setup

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools" / "errands"))

from errands import COMPARED, EMBEDDED, FIRST, HOMES, LABEL, US, run_all, shares, table

# What is asked of true boxes with faults: things that stayed, things that moved, and absent ones.
TARGETS = {
    "standing": (("relation", "order"), 0.9),
    "moved": (("moved",), 0.8),
    "not_there": (("absent", "removed"), 0.95),
}


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`; the embedded detector needs MuJoCo."""
    homes, compared = (1, 1) if setup.quick else (HOMES, COMPARED)
    by_kind = run_all(FIRST, homes, compared, 0 if setup.quick or not _can_render() else EMBEDDED)
    outcomes = by_kind["boxes"]
    print(table(outcomes))
    found = []
    for name, (kinds, target) in TARGETS.items():
        right, count = shares(outcomes, US, *kinds)
        by_name, _ = shares(outcomes, LABEL, *kinds)
        found.append(
            Figure(
                f"errands_{name}",
                right / max(count, 1),
                "share",
                target=target,
                more_is_better=True,
                reference="" if name == "moved" else "the nearest object with the name",
                reference_value=None if name == "moved" else by_name / max(count, 1),
                note=f"{right} of {count} errands in {homes} homes; true boxes with faults",
            )
        )
    embedded = by_kind["embedded"]
    if embedded:
        print(table(embedded))
        right, count = shares(embedded, US, "relation", "order", "moved")
        note = f"{right} of {count} errands in {EMBEDDED} homes; the detector on rendered images"
        found.append(
            Figure("errands_embedded", right / count, "share", more_is_better=True, note=note)
        )
    return found


def _can_render() -> bool:
    """Whether MuJoCo is there, for the colours."""
    return importlib.util.find_spec("mujoco") is not None
