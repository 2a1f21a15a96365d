"""`python -m fuzz [MINUTES]`: run cases, print figures, keep the cases that failed."""

import argparse
import os
import resource
import sys
import time
from pathlib import Path

from fuzz.harness import CORPUS, keep, run_cases
from fuzz.targets import TARGETS


def main() -> int:
    """Returns 1 if a case failed."""
    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=__doc__)
    parser.add_argument("minutes", nargs="?", type=float, default=5.0)
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=time.time_ns() // 10**9, help="of the cases")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--corpus", type=Path, default=CORPUS, help="folder of failed cases")
    options = parser.parse_args()
    print(f"seed {options.seed}, {len(options.targets)} targets, {options.jobs} processes")
    report = run_cases(
        options.targets, seed=options.seed, jobs=options.jobs, seconds=60 * options.minutes
    )
    for name, count in sorted(report.cases.items()):
        print(f"  {name:24} {count:7}  {1000 * report.seconds[name] / count:7.1f} ms each")
    print(f"{sum(report.cases.values())} cases, {len(report.failures)} failures")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss >> 10
    print(f"most memory: {peak} MB in a process of cases")
    for path in keep(report, options.corpus):
        print(f"kept {path}")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
