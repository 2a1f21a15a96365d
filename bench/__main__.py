"""Run all benchmarks that need one machine, and write their figures.

    python -m bench [--json FILE] [--only NAME ...] [--data FOLDER] [--quick] [--list]

Each benchmark runs in its own process. One that fails is reported, and the others still run. The
exit code is 1 if one failed. A figure that misses its target is no failure.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.entries import ENTRIES, Entry
from bench.figures import Figure, Setup

ROOT = Path(__file__).resolve().parents[1]
# The folder of reference data beside the project, as the tests use it.
DATA = ROOT.parent / "shared" / "data"
# Of the output of a failed benchmark that is kept.
KEPT_CHARACTERS = 4000


def run_entry(entry: Entry, setup: Setup) -> dict[str, Any]:
    """Run a benchmark in a new process; its figures, or why there are none, and its seconds."""
    fields = {"data": None if setup.data is None else str(setup.data), "quick": setup.quick}
    paths = [str(ROOT), str(ROOT / "test"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result.json"
        command = [sys.executable, "-m", "bench.worker", entry.name, json.dumps(fields), result]
        done: dict[str, Any]
        try:
            subprocess.run(
                command,
                env=environment,
                check=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=entry.limit_s,
            )
            done = json.loads(result.read_text(encoding="utf-8"))
        except subprocess.TimeoutExpired:
            done = {"error": f"ended after {entry.limit_s:g} s"}
        except subprocess.CalledProcessError as error:
            done = {"error": error.output[-KEPT_CHARACTERS:] or f"exit code {error.returncode}"}
        except (OSError, json.JSONDecodeError) as error:
            done = {"error": f"the benchmark left no result: {error}"}
    return {**done, "seconds": round(time.perf_counter() - start, 1)}


def run_all(entries: list[Entry], setup: Setup) -> dict[str, Any]:
    """Run benchmarks one after the other; the content of the JSON file."""
    report: dict[str, Any] = {**circumstances(), "quick": setup.quick, "benchmarks": {}}
    figures: list[dict[str, Any]] = []
    for entry in entries:
        print(f"{entry.name} (about {entry.takes_s:g} s) …", flush=True)
        done = run_entry(entry, setup)
        found = [Figure(**fields) for fields in done.pop("figures", [])]
        for figure in found:
            print("  " + line_of(figure))
            row = {**dataclasses.asdict(figure), "reached": figure.reached}
            figures.append({"benchmark": entry.name, **row})
        for key in ("missing", "error"):
            if key in done:
                print(f"  {key}: {done[key]}")
        report["benchmarks"][entry.name] = done
    report["figures"] = figures
    report["load_at_end"] = os.getloadavg()[0]
    return report


def circumstances() -> dict[str, Any]:
    """Commit, machine, date and versions."""
    from deworldsg_ros.base.timing import device_name

    now = datetime.datetime.now(datetime.timezone.utc)
    return {
        "commit": git("rev-parse", "--short", "HEAD"),
        "changed_files": len(git("status", "--porcelain", "--untracked-files=no").splitlines()),
        "date": now.isoformat(timespec="seconds"),
        "machine": device_name(),
        "cores": len(os.sched_getaffinity(0)),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load_at_start": os.getloadavg()[0],
    }


def git(*arguments: str) -> str:
    """Output of git in the checkout; empty outside of one."""
    with contextlib.suppress(OSError):
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return ""


def line_of(figure: Figure) -> str:
    """A figure in one line."""
    text = f"{figure.name}: {figure.value:.4g} {figure.unit}"
    if figure.target is not None:
        text += f" (to reach: {'≥' if figure.more_is_better else '≤'} {figure.target:g})"
    if figure.ratio is not None:
        text += f", {figure.ratio:.3g}× {figure.reference}"
        if figure.ratio_target is not None:
            text += f" (to reach: ≥ {figure.ratio_target:g}×)"
    if figure.reached is not None:
        text += " – reached" if figure.reached else " – not reached"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to this file")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=ENTRIES, help="only these")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of redkitchen and rooms")
    parser.add_argument("--quick", action="store_true", help="few rounds: does it work?")
    parser.add_argument("--list", action="store_true", help="print the names and end")
    options = parser.parse_args()
    if options.list:
        print("\n".join(ENTRIES))
        return
    unasked = [name for name, entry in ENTRIES.items() if not entry.only]
    entries = [ENTRIES[name] for name in options.only or unasked]
    data = options.data.resolve() if options.data.is_dir() else None
    report = run_all(entries, Setup(data, options.quick))
    if options.json is not None:
        text = json.dumps(report, indent=1, ensure_ascii=False)
        options.json.write_text(text + "\n", encoding="utf-8")
    failed = [name for name, done in report["benchmarks"].items() if "error" in done]
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
