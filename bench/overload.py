"""Frames a second that reach the graph when the camera is faster than the nodes, over DDS.

    python -m bench.overload [--seconds 15] [--one-process]

As `bench.latency` with recorded detections, at 30, 60 and 120 Hz. The camera runs on the same
machine and takes a part of its processors, more at a higher rate.
"""

from __future__ import annotations

import argparse

from bench.figures import Figure, Setup
from bench.latency import Result, measure, show

RATES_HZ = (30.0, 60.0, 120.0)


def runs(seconds: float, *, one_process: bool) -> dict[float, Result]:
    """One run at each rate, by the rate."""
    return {rate: measure(seconds, rate, one_process=one_process) for rate in RATES_HZ}


def figures(setup: Setup) -> list[Figure]:
    """Throughput at each rate, and frames that no node counted."""
    seconds = 3.0 if setup.quick else 10.0
    found = []
    for one_process in (False, True):
        name = f"overload_{'one_process' if one_process else 'four_processes'}"
        results = runs(seconds, one_process=one_process)
        for rate, result in results.items():
            found += [
                Figure(
                    f"{name}_{rate:g}_hz",
                    len(result.latencies_ms) / seconds,
                    "frames/s",
                    more_is_better=True,
                    note=f"frames that reached the graph, {seconds:g} s, recorded detections",
                ),
                Figure(
                    f"{name}_{rate:g}_hz_uncounted",
                    abs(result.uncounted),
                    "frames",
                    target=0,
                    note=f"neither in the graph nor counted, of {result.published}",
                ),
            ]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--one-process", action="store_true", help="deworldsg_node")
    parser.add_argument("--rates", type=float, nargs="*", default=RATES_HZ, help="Hz")
    options = parser.parse_args()
    for rate in options.rates:
        result = measure(options.seconds, rate, one_process=options.one_process)
        print(f"== {rate:g} Hz: {len(result.latencies_ms) / options.seconds:.1f} frames a second")
        show(result)


if __name__ == "__main__":
    main()
