"""`python -m endurance.crash [KILLS]`: kill -9 of the nodes at random moments of a replay."""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.map_file import read_map
from endurance.rig import NODES, Rig

# A node is restarted at once. The graph has to be updated again within this time after the restart.
WHOLE_WITHIN_S = 5.0
PATIENCE_S = 30.0
# Importing, compiled kernels from their cache, weights: on a busy machine with two cores.
START_LIMIT_S = 120.0
FIRST_GRAPH_S = 60.0
# Between two kills: 50 kills take about five minutes on two idle cores.
LONGEST_LIFE_S = 4.0


@dataclass(frozen=True)
class Recovery:
    """What a kill of a node cost: the time until it was ready, from then until the graph was
    updated again, and what was lost, in words."""

    node: str
    start_s: float
    whole_s: float
    problem: str = ""

    @property
    def recovered_s(self) -> float:
        return self.start_s + self.whole_s


def kill_and_restart(rig: Rig, name: str) -> Recovery:
    rig.kill(name)
    kept: set[int] = set()
    if name == "graph_node":
        kept = rig.kept = kept_ids(rig)
        rig.graph = None
    started_s = time.monotonic()
    rig.start(name)
    process = rig.processes[name]
    rig.run(START_LIMIT_S, lambda: "ready" in process.log or not process.alive)
    ready_s, before = time.monotonic(), rig.updates
    if not process.alive or "ready" not in process.log:
        return Recovery(name, ready_s - started_s, 0.0, f"not ready: {process.log[-300:]}")
    whole = rig.run(PATIENCE_S, lambda: rig.updates > before and rig.graph is not None)
    problem = "" if whole else f"the graph is not updated in {PATIENCE_S:g} s"
    if rig.graph is not None:
        lost = sorted(kept - {node.id for node in rig.graph.nodes})
        # A node can be merged into another, or be seen to be gone, before the first whole graph.
        if len(lost) > 0.1 * len(kept):
            problem = f"ids {lost} of {len(kept)} are lost"
        if again := given_again(rig):
            problem = f"ids {sorted(again)} are given again"
    return Recovery(name, ready_s - started_s, time.monotonic() - ready_s, problem)


def given_again(rig: Rig) -> set[int]:
    """Ids of the newest session that one before had published, and that its map did not have."""
    *before, newest = rig.published.values()
    return newest & set().union(*before) - rig.kept


def kept_ids(rig: Rig) -> set[int]:
    """Ids of the nodes in the last checkpoint, which no kill breaks; empty before the first."""
    if not rig.map_path.exists():
        return set()
    return set(read_map(Config(), rig.map_path).graph.nodes.slot_of)


def crash(kills: int, folder: Path, seed: int = 0, only: str | None = None) -> list[Recovery]:
    """Kill nodes at random moments; each at least once if there are enough kills, or `only` one."""
    random = np.random.default_rng(seed)
    rig = Rig(folder)
    recoveries = []
    try:
        rig.start_all()
        assert rig.run(FIRST_GRAPH_S, lambda: rig.graph is not None and len(rig.graph.nodes) > 2)
        for kill in range(kills):
            rig.run(random.uniform(0.2, LONGEST_LIFE_S))
            name = NODES[-1 - kill % 4] if kill < 4 else str(random.choice(NODES))
            recoveries.append(kill_and_restart(rig, only or name))
            print(recoveries[-1], flush=True)
        assert not list(folder.glob(".deworldsg-*.ready"))
    finally:
        rig.close()
    return recoveries


def main() -> int:
    """Returns 1 if a kill cost more than it may."""
    parser = argparse.ArgumentParser(prog="scripts/crash", description=__doc__)
    parser.add_argument("kills", nargs="?", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--node", choices=NODES, help="kill only this one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recoveries = crash(options.kills, Path(folder), options.seed, options.node)
    problems = [item for item in recoveries if item.problem]
    late = [item for item in recoveries if item.recovered_s > WHOLE_WITHIN_S]
    print(f"{len(recoveries)} kills, {len(problems)} problems, {len(late)} later than 5 s")
    for what, name in (("updated graph", "recovered_s"), ("ready", "start_s")):
        times_s = [getattr(item, name) for item in recoveries]
        median_s, most_s = np.median(times_s), max(times_s)
        print(f"  restart to {what}: {median_s:.1f} s (median), {most_s:.1f} s (most)")
    return 1 if problems or late else 0


if __name__ == "__main__":
    sys.exit(main())
