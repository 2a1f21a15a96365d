"""The benchmarks of `python -m bench`. A new one is a function and a line here.

A benchmark is a function of a `Setup` that returns its figures. Each runs in a process of its own:
it may set threads, measure memory and crash.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from bench.figures import Figure, Setup


@dataclass(frozen=True)
class Entry:
    """One benchmark.

    Attributes:
        name: on the command line.
        function: ``module:function``; the module is imported in the process of the benchmark.
        limit_s: it is ended after this time.
        takes_s: about how long it runs on two cores.
        only: it runs only if it is named.
    """

    name: str
    function: str
    limit_s: float
    takes_s: float
    only: bool = False

    def run(self, setup: Setup) -> list[Figure]:
        """Run it in this process."""
        module, _, name = self.function.partition(":")
        function: Callable[[Setup], list[Figure]] = getattr(importlib.import_module(module), name)
        return function(setup)


# The sum of the limits is no bound: those that run unasked together take less than ten minutes.
ENTRIES = {
    entry.name: entry
    for entry in (
        Entry("lifting", "bench.lifting:figures", limit_s=120, takes_s=8),
        Entry("integration", "bench.integration:figures", limit_s=300, takes_s=30),
        Entry("slam", "bench.slam:figures", limit_s=300, takes_s=90),
        Entry("step", "bench.step:figures", limit_s=240, takes_s=20),
        Entry("fross", "bench.fross:figures", limit_s=240, takes_s=40),
        Entry("merging_search", "bench.merging:search_figures", limit_s=120, takes_s=5),
        Entry("kitchen", "bench.kitchen:figures", limit_s=240, takes_s=35),
        Entry("relocalisation", "bench.relocalisation:figures", limit_s=480, takes_s=100),
        Entry("memory", "bench.memory:figures", limit_s=120, takes_s=8),
        Entry("building", "bench.building:figures", limit_s=240, takes_s=38),
        Entry("rooms", "bench.rooms:figures", limit_s=240, takes_s=60),
        Entry("falls", "bench.falls:figures", limit_s=600, takes_s=120),
        Entry("exploration", "bench.exploration:figures", limit_s=480, takes_s=120),
        Entry("store", "bench.store:figures", limit_s=180, takes_s=20),
        Entry("live_page", "bench.live_page:figures", limit_s=240, takes_s=40),
        Entry("compile", "bench.start:compile_figures", limit_s=240, takes_s=50),
        Entry("start", "bench.start:node_figures", limit_s=180, takes_s=25),
        Entry("start_demo", "bench.start:demo_figures", limit_s=240, takes_s=25),
        Entry("latency", "bench.latency:figures", limit_s=420, takes_s=205),
        Entry("overload", "bench.overload:figures", limit_s=240, takes_s=80),
        Entry("errands", "bench.errands:figures", limit_s=3600, takes_s=1200, only=True),
    )
}
