"""Frames a second that reach the graph when the camera is faster than the nodes, over DDS.

    python -m bench.overload [--seconds 15] [--one-process]

As `bench.latency` with recorded detections, at 30, 60 and 120 Hz. The camera runs on the same
machine and takes a part of its processors, more at a higher rate.
"""

from __future__ import annotations

import argparse

from bench.figures import Figure, Setup
from bench.latency import USUAL_RATE_HZ, measure, show

RATES_HZ = (30.0, 60.0, 120.0)
# Of the recording: their detections are made anew for each run.
FRAMES = 60


def figures(setup: Setup) -> list[Figure]:
    """Throughput at each rate, and frames that no node counted."""
    seconds = 3.0 if setup.quick else 5.0
    found = []
    for rate in RATES_HZ[1:]:  # bench.latency has the rate of a camera
        result = measure(seconds, rate, max_frames=FRAMES)
        found += [
            Figure(
                f"overload_{rate:g}_hz",
                len(result.latencies_ms) / seconds,
                "frames/s",
                target=USUAL_RATE_HZ,
                more_is_better=True,
                note=f"in the graph, {seconds:g} s, four processes, recorded detections; "
                f"{result.percentile_ms(50):.0f} ms from the stamp to the update",
            ),
            Figure(
                f"overload_{rate:g}_hz_uncounted",
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
