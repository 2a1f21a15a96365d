"""Errands in simulated homes (tools/errands): how many are fulfilled, and by other methods.

python -m bench --only errands
"""

from __future__ import annotations

import sys
from pathlib import Path

from bench.figures import Figure, Setup

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools" / "errands"))

from errands import FIRST, HOMES, LABEL, US, run_all, shares, table

# What is asked of true boxes with faults: things that stayed, things that moved, and absent ones.
TARGETS = {
    "standing": (("relation", "order"), 0.9),
    "moved": (("moved",), 0.8),
    "not_there": (("absent", "removed"), 0.95),
}
EMBEDDED_HOMES = 2


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`; the embedded detector needs MuJoCo."""
    homes = 1 if setup.quick else HOMES
    outcomes = run_all(range(FIRST, FIRST + homes), "boxes", 2, others=True)
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
    if not setup.quick:
        found += _embedded()
    return found


def _embedded() -> list[Figure]:
    try:
        import mujoco  # noqa: F401  colours for the detector
    except ImportError:
        return []
    outcomes = run_all(range(FIRST, FIRST + EMBEDDED_HOMES), "embedded", 2)
    print(table(outcomes))
    right, count = shares(outcomes, US, "relation", "order", "moved")
    note = f"{right} of {count} errands in {EMBEDDED_HOMES} homes; the detector on rendered images"
    return [
        Figure("errands_embedded", right / max(count, 1), "share", more_is_better=True, note=note)
    ]
