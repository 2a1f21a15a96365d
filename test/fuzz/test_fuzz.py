"""Every case that ever failed, and a part of the nightly cases; `scripts/fuzz` runs more."""

import os
import signal
from contextlib import closing

import pytest

from fuzz.harness import CORPUS, corpus_cases, run_cases
from fuzz.mutations import MAX_CASE_BYTES
from fuzz.targets import TARGETS
from fuzz.worker import Worker


@pytest.fixture(scope="module")
def worker():
    with closing(Worker()) as one:
        yield one


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", TARGETS)
def test_good_files_are_read_and_cases_that_failed_once_no_longer_do(worker, name):
    cases = corpus_cases(name)
    assert list(worker.run(name, cases)) == [None] * len(cases)


def test_the_corpus_has_cases_of_known_targets_only():
    assert {path.name for path in CORPUS.iterdir() if path.is_dir()} <= set(TARGETS)


def test_a_process_that_dies_is_a_failure_and_is_replaced(worker):
    cases = [("set.txt", b"output.rate_hz=3")]
    assert list(worker.run("set_option", cases)) == [None]
    os.kill(worker.process.pid, signal.SIGKILL)
    (failure,) = worker.run("set_option", cases)
    assert failure is not None and "crash" in failure.text
    assert list(worker.run("set_option", cases)) == [None]


def test_the_same_seed_makes_the_same_cases_and_none_is_huge():
    target, good = TARGETS["config_yaml"], {"config.yaml": b"a: [1, x]\nb: {c: 2.5}\n" * 50}

    made, again = [], []
    for contents in (made, again):
        for turn in range(20):
            target.make_cases(good, str(turn), 10, lambda _, it, to=contents: to.append(it))
    assert made == again and len(set(made)) > 50
    assert max(map(len, made)) <= MAX_CASE_BYTES


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("count", [2000, pytest.param(40_000, marks=pytest.mark.nightly)])
def test_no_case_fails(count):
    report = run_cases(TARGETS, seed=1, jobs=min(os.cpu_count() or 1, 4), cases=count)
    assert sum(report.cases.values()) >= count
    assert [failure.text for failure in report.failures.values()] == []
