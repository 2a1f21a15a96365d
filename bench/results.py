"""Tables of docs/dev/evaluation/results.md: python -m bench.results DIR --rooms A --simulated B

Each run of `RUNS` is one `deworldsg evaluate table`; DIR keeps its figures. A run that DIR has is
not repeated, and an interrupted one goes on where it stopped. Without folders, the tables are made
from the figures that DIR has; a table stays if one of its runs has none. The rendered rooms (A) are
not in the repository; tools/physics_rooms/make_rooms.py makes the simulated ones (B), and those of
``--new C``. No figure in the tables is typed by hand; the text around them is.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.__main__ import ROOT, git
from deworldsg_ros.evaluation.edge_measures import COMPLETE_PREDICATES

PAGE = ROOT / "docs" / "dev" / "evaluation" / "results.md"
# A table of the page: its name, and the lines that are made here.
PLACE = re.compile(r"(?<=<!-- table: )(.*?) -->\n.*?(?=<!-- end -->)", re.DOTALL)

ROOMS = "ROOMS --layout replica --scan rooms_0 --scan rooms_1"
RECORDING = "bags/demo_room --layout recording"
SIMULATED = "SIMULATED --layout replica"
NEW = "NEW --layout replica --scan phys_000 --scan phys_001 --scan phys_002 --scan phys_003"
FAULTS = "--flip 0.1 --miss 0.1 --jitter 2"
ALL_PAIRS = "--set paper_rules:relations.edge_belief=all_pairs"
# Ridges of Eq. 4, square metres. The configurations have 1.0e-6.
RIDGES = ("1.0e-8", "1.0e-5", "1.0e-4", "1.0e-3")
# Arguments of `deworldsg evaluate table`, by the name of the run; the most important first.
RUNS = {
    "rooms": f"main {ROOMS} --front-end recorded",
    "rooms_flip": f"main {ROOMS} --front-end recorded --flip 0.1",
    "recording_embedded": f"main {RECORDING} --front-end backend",
    "recording": f"main {RECORDING} --front-end ground-truth",
    "recording_flip": f"main {RECORDING} --front-end ground-truth --flip 0.1",
    "rooms_embedded": f"main {ROOMS} --front-end backend",
    "rooms_boxes": f"main {ROOMS} --front-end boxes",
    "poses": f"pose {ROOMS} --front-end recorded --poses perturbed --poses odometry",
    "faults": f"hard {ROOMS} --front-end recorded",
    "simulated": f"main {SIMULATED} --front-end ground-truth",
    "simulated_boxes": f"main {SIMULATED} --front-end boxes",
    "rooms_truth": f"main {ROOMS} --front-end ground-truth",
    "rooms_truth_faults": f"main {ROOMS} --front-end ground-truth {FAULTS}",
    "ablation": f"ablation {ROOMS} --front-end recorded",
    "new_boxes": f"main {NEW} --front-end boxes",
    "new_embedded": f"main {NEW} --front-end backend",
    "simulated_faults": f"hard {SIMULATED} --front-end ground-truth",
    "rooms_all_pairs": f"main {ROOMS} --front-end recorded {ALL_PAIRS}",
    "rooms_boxes_all_pairs": f"main {ROOMS} --front-end boxes {ALL_PAIRS}",
    "recording_embedded_all_pairs": f"main {RECORDING} --front-end backend {ALL_PAIRS}",
}
for ridge in RIDGES:
    change = f"--set lifting.covariance_ridge_m2={ridge}"
    RUNS[f"rooms_{ridge}"] = f"main {ROOMS} --front-end recorded {change}"
    RUNS[f"recording_{ridge}"] = f"main {RECORDING} --front-end backend {change}"

# The runs of each table with the name of their input. A run of several inputs names them itself.
TABLES = {
    "new rooms": {"new_boxes": "true boxes", "new_embedded": "embedded"},
    "methods": {"rooms": "right labels", "rooms_flip": "a tenth of the labels is wrong"},
    "front ends": {
        "rooms_truth": "ground truth",
        "rooms_truth_faults": "ground truth, faults",
        "rooms_boxes": "true boxes",
        "rooms_embedded": "embedded",
    },
    "recording": {
        "recording": "ground truth",
        "recording_flip": "ground truth, `--flip 0.1`",
        "recording_embedded": "embedded",
    },
    "faults": {"faults": ""},
    "poses": {"rooms": "true", "poses": ""},
    "simulated": {"simulated": "ground truth", "simulated_boxes": "true boxes"},
    "simulated faults": {"simulated_faults": ""},
    "ablation": {"ablation": "right labels"},
    "predicates": {"rooms_boxes": "rendered", "simulated_boxes": "simulated"},
    "pairs": {
        "rooms": "recorded, pairs of Eq. 8",
        "rooms_all_pairs": "recorded, all pairs",
        "rooms_boxes": "true boxes, pairs of Eq. 8",
        "rooms_boxes_all_pairs": "true boxes, all pairs",
        "recording_embedded": "recording, pairs of Eq. 8",
        "recording_embedded_all_pairs": "recording, all pairs",
    },
    "ridge": {
        name if ridge == "1.0e-6" else f"{what}_{ridge}": f"{what}, {ridge} m²"
        for what, name in (("rooms", "rooms"), ("recording", "recording_embedded"))
        for ridge in sorted((*RIDGES, "1.0e-6"), key=float)
    },
}
# Tables of one method.
ONLY = {"pairs": ("paper_rules",), "ridge": ("paper_rules",)}
# The name of a row is METHOD or METHOD-INPUT.
METHODS = {
    "fross": "FROSS",
    "kim": "Kim et al.",
    "paper_rules": "`paper_rules`",
    "default": "`default`",
    "a": "(a) box lifting",
    "b": "(b) + masks",
    "c": "(c) + depth refinement",
}
INPUTS = {
    "plain": "unchanged",
    "label": "`label=0.1`",
    "false": "`false=1`",
    "bleed": "`bleed=0.3`",
    "merge": "`merge=0.1`",
    "cut": "`cut=0.3`",
    "jitter": "poses ± 2 cm, ± 1°",
    "all": "all together",
    "perturbed": "perturbed",
    "odometry": "odometry",
}
# Heading, number of the JSON file, factor, decimals.
COLUMNS = (
    ("Rel.", "relationship_recall", 100, 1),
    ("Obj.", "object_recall", 100, 1),
    ("Pred.", "predicate_recall", 100, 1),
    ("of det.", "predicate_recall_of_detected", 100, 1),
    ("nodes", "nodes", 1, 0),
    ("found", "found", 1, 0),
    ("dup.", "duplicates", 1, 0),
    ("wrong", "wrong_class", 1, 0),
    ("stray", "stray", 1, 0),
    ("precision", "node_precision", 100, 1),
    ("F1", "f1", 100, 1),
    ("cm", "centroid_error_main_median_m", 100, 1),
    ("edges", "complete_edges_said", 1, 0),
    ("edge precision", "complete_edge_precision", 100, 1),
    ("edge recall", "complete_edge_recall", 100, 1),
    ("edge ECE", "complete_edge_calibration_error", 100, 1),
    ("unmatched", "complete_edges_unmatched", 1, 0),
)
PREDICATES = (*COMPLETE_PREDICATES, "near", "with")
SUMS = ("relations", "relations_found", "edges_said", "edges_right")


def run(out: Path, folders: Mapping[str, Path], workers: int) -> None:
    """Run what `out` has no figures of and `folders` has data for.

    Raises:
        SystemExit: `out` has figures of another version of the package.
    """
    kept = out / "commit"
    if not kept.exists():
        out.mkdir(parents=True, exist_ok=True)
        kept.write_text(git("rev-parse", "--short", "HEAD"))
    if changed := git("diff", "--stat", kept.read_text(), "--", "deworldsg_ros", "config"):
        raise SystemExit(f"{out} has figures of commit {kept.read_text()}. Since then:\n{changed}")
    for name, arguments in RUNS.items():
        words = arguments.split()
        if words[1].isupper() and words[1] not in folders or (out / f"{name}.json").exists():
            continue
        print(name, flush=True)
        words = [str(folders.get(word, word)) for word in words]
        files = ["--out", str(out / name), "--json", str(out / f"{name}.json")]
        options = ["--checkpoints", "0", "--workers", str(workers)]
        command = ["deworldsg", "evaluate", "table", *words, *options, *files]
        subprocess.run(command, cwd=ROOT, check=True)


def cells_of(row: Mapping[str, Any]) -> list[str]:
    """The figures of a row of a run; raises SystemExit if one of its scans failed."""
    if row["failed"]:
        raise SystemExit(f"{row['title']}: {row['failed']}")
    values = [(row[name], factor, decimals) for _, name, factor, decimals in COLUMNS]
    return ["–" if v is None else f"{v * factor:.{decimals}f}" for v, factor, decimals in values]


def markdown(headings: list[str], rows: list[list[str]]) -> list[str]:
    """A table in Markdown."""
    rows = [headings, ["---"] * len(headings), *rows]
    return ["| " + " | ".join(row) + " |" for row in rows]


def table(name: str, reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A table of the page."""
    rows = []
    for run_name, input_name in TABLES[name].items():
        for row in reports[run_name]["rows"]:
            method, _, condition = row["name"].partition("-")
            if method in ONLY.get(name, METHODS):
                what = input_name or INPUTS[condition]
                rows.append([what, METHODS[method], *cells_of(row)])
    return markdown(["input", "method", *(heading for heading, *_ in COLUMNS)], rows)


def predicates(reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The edges of `default` by predicate, summed over the scans of each run."""
    inputs = TABLES["predicates"]
    rows = []
    for predicate in PREDICATES:
        cells = [predicate]
        for name in inputs:
            default = next(row for row in reports[name]["rows"] if row["name"] == "default")
            parts = [scan["measures"]["edges_by_predicate"] for scan in default["scans"]]
            relations, found, said, right = (
                sum(part.get(predicate, {}).get(key, 0) for part in parts) for key in SUMS
            )
            cells += [str(relations), percent(found, relations), str(said), percent(right, said)]
        rows.append(cells)
    columns = ("relations", "recall", "edges", "precision")
    headings = [f"{what}: {column}" for what in inputs.values() for column in columns]
    return markdown(["predicate", *headings], rows)


def percent(part: int, whole: int) -> str:
    """A fraction in percent."""
    return f"{100 * part / whole:.1f}" if whole else "–"


def page(text: str, reports: Mapping[str, Mapping[str, Any]], commit: str) -> str:
    """The page with new tables; a table stays if one of its runs has no report."""

    def place(found: re.Match[str]) -> str:
        name = found[1]
        if not set(TABLES[name]) <= set(reports):
            return found[0]
        commands = [f"deworldsg evaluate table {RUNS[run_name]}" for run_name in TABLES[name]]
        lines = predicates(reports) if name == "predicates" else table(name, reports)
        return "\n".join(
            [f"{name} -->", "```", f"# commit {commit}", *commands, "```", "", *lines, ""]
        )

    return PLACE.sub(place, text)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.results", description=__doc__)
    parser.add_argument("out", type=Path, metavar="DIR", help="figures, and results of the scans")
    parser.add_argument(
        "--rooms", type=Path, metavar="FOLDER", help="the rendered rooms; not in the repository"
    )
    parser.add_argument(
        "--simulated", type=Path, metavar="FOLDER", help="of tools/physics_rooms/make_rooms.py"
    )
    parser.add_argument("--new", type=Path, metavar="FOLDER", help="likewise, of another seed")
    parser.add_argument("--workers", type=int, default=0, help="processes; default: one per core")
    options = parser.parse_args()
    out = options.out.resolve()
    given = {"ROOMS": options.rooms, "SIMULATED": options.simulated, "NEW": options.new}
    if folders := {name: folder.resolve() for name, folder in given.items() if folder}:
        run(out, folders, options.workers)
    files = {name: out / f"{name}.json" for name in RUNS}
    reports = {name: json.loads(file.read_text()) for name, file in files.items() if file.exists()}
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page(text, reports, (out / "commit").read_text()), encoding="utf-8")


if __name__ == "__main__":
    main()
