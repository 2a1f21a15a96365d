"""Every case that ever failed, and a part of the nightly cases; `scripts/fuzz` runs more."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from fuzz.harness import CORPUS, corpus_cases, run_parallel
from fuzz.targets import TARGETS
from fuzz.worker import Worker

CASES = 5000


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    one = Worker()
    yield one
    one.close()


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", TARGETS)
def test_good_files_are_read_and_cases_that_failed_once_no_longer_do(worker, name):
    assert worker.members(name)
    for member, content in corpus_cases(name):
        assert worker.run(name, member, content) is None, member


def test_the_corpus_has_cases_of_known_targets_only():
    assert {path.name for path in CORPUS.iterdir() if path.is_dir()} <= set(TARGETS)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_no_case_fails():
    report = run_parallel(TARGETS, seed=1, jobs=min(os.cpu_count() or 1, 4), cases=CASES)
    assert sum(report.cases.values()) >= CASES
    assert not report.failures, str(report)
