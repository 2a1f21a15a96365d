"""Write docs/dev/performance.md from figures of `python -m bench`: python -m bench.page FILE.json

The tables contain no figure that is typed by hand, except those of before (`BEFORE`), which nothing
can measure again.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[1] / "docs" / "dev" / "performance.md"
# Figures before the work on speed, on two idle cores (commit 1bc6f72), by the name of the figure.
BEFORE = {
    "update_1000_nodes": "12 ms",
    "update_10000_nodes": "457 ms",
    "integrate_1000_nodes": "1.2 ms",
    "integrate_10000_nodes": "1.8 ms",
    "lifting_smooth": "4.7 ms, 8.5×",
    "kitchen_run": "20 frames/s",
    "memory_per_node": "69 kB",
    "compile_cold": "20–30 s",
}
# The text of the page around the tables.
TEXT = Path(__file__).with_name("page.md")
HEADER = ("figure", "before", "now", "target", "ratio", "compared with")


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A table of figures in Markdown."""
    lines = [
        "| figure | before | now | target | ratio | compared with |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        sign = "≥" if row["more_is_better"] else "≤"
        target = "" if row["target"] is None else f"{sign} {row['target']:g} {row['unit']}"
        if row["ratio_target"] is not None:
            target += f", ≥ {row['ratio_target']:g}×"
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.3g}×"
        mark = {True: " ✓", False: " ✗", None: ""}[row["reached"]]
        now = f"{row['value']:.3g} {row['unit']}{mark}"
        cells = (f"`{row['name']}`", BEFORE.get(row["name"], ""), now, target, ratio)
        lines.append("| " + " | ".join((*cells, row["reference"])) + " |")
    return lines


def page(report: dict[str, Any]) -> str:
    """The whole page."""
    lines = [
        f"Commit {report['commit']}, {report['date'][:10]}, {report['machine']}, "
        f"Python {report['python']}, load {report['load_at_start']:.1f} at the start and "
        f"{report['load_at_end']:.1f} at the end.",
    ]
    for name, done in report["benchmarks"].items():
        lines += ["", f"## `{name}`", ""]
        rows = [row for row in report["figures"] if row["benchmark"] == name]
        if rows:
            notes = dict.fromkeys(row["note"] for row in rows if row["note"])
            lines += [*table(rows), "", *(f"- {note}" for note in notes)]
        for reason in ("missing", "error"):
            if reason in done:
                lines.append(f"Not measured: {done[reason].splitlines()[-1]}")
    text = TEXT.read_text(encoding="utf-8").replace("](../docs/dev/", "](")
    return text.replace("(the tables)", "\n".join(lines))


if __name__ == "__main__":
    PAGE.write_text(page(json.loads(Path(sys.argv[1]).read_text())), encoding="utf-8")
