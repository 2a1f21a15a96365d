"""`python -m bench`: each benchmark has a process of its own, and may fail alone."""

import json
import sys

import pytest

from bench.__main__ import main, run_all
from bench.entries import ENTRIES, Entry
from bench.figures import Setup

# The quickest, without data.
QUICK = ("lifting", "merging_search")


def test_the_quickest_benchmarks_write_their_figures(tmp_path, monkeypatch):
    out = tmp_path / "figures.json"
    monkeypatch.setattr(sys, "argv", ["bench", "--quick", "--json", str(out), "--only", *QUICK])
    with pytest.raises(SystemExit) as end:
        main()
    report = json.loads(out.read_text())
    assert end.value.code == 0
    assert set(report["benchmarks"]) == set(QUICK)
    assert report["cores"] >= 1 and report["date"] and report["machine"]
    assert {figure["benchmark"] for figure in report["figures"]} == set(QUICK)
    for figure in report["figures"]:
        assert figure["value"] > 0 and figure["unit"] == "ms"
        assert figure["reference"] and figure["ratio"] > 1


def test_a_benchmark_that_fails_leaves_the_others_their_figures():
    failing = Entry("failing", "bench.entries:NO_SUCH_FUNCTION", limit_s=60, takes_s=1)
    slow = Entry("slow", "time:sleep", limit_s=0.01, takes_s=1)
    report = run_all([failing, slow, ENTRIES["lifting"]], Setup(quick=True))
    assert "KeyError: 'failing'" in report["benchmarks"]["failing"]["error"]
    assert report["benchmarks"]["slow"]["error"] == "ended after 0.01 s"
    assert {figure["benchmark"] for figure in report["figures"]} == {"lifting"}
