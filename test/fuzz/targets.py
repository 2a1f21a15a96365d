"""All targets by name. Another area adds a module with a list `TARGETS` and its name here."""

from __future__ import annotations

from fuzz import file_targets, wire_targets
from fuzz.target import Target

TARGETS: dict[str, Target] = {
    target.name: target for target in (*file_targets.TARGETS, *wire_targets.TARGETS)
}
