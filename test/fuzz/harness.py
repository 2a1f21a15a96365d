"""Makes cases for the targets, runs them, and keeps the cases that failed."""

from __future__ import annotations

import hashlib
import random
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, unquote

import hypothesis

from fuzz.mutations import mutate
from fuzz.target import Target
from fuzz.targets import TARGETS
from fuzz.worker import Worker

CORPUS = Path(__file__).resolve().parent / "corpus"
# Larger cases are reported, but not kept in the repository.
MAX_CORPUS_BYTES = 100_000
# Cases of one target before the next one has its turn.
TURN = 25


@dataclass
class Report:
    """What a run found.

    Attributes:
        cases: number of cases by target.
        failures: by target and place in the code, the case that failed first (file name, content).
        texts: by the same, the failure in words.
    """

    cases: Counter[str] = field(default_factory=Counter)
    failures: dict[tuple[str, str], tuple[str, bytes]] = field(default_factory=dict)
    texts: dict[tuple[str, str], str] = field(default_factory=dict)

    def add(self, target: str, member: str, content: bytes, failure: str | None) -> None:
        """Count a case. A failure counts once for each target and place in the code."""
        self.cases[target] += 1
        if failure is not None:
            key = target, failure.split(": ", 2)[1]
            self.failures.setdefault(key, (member, content))
            self.texts.setdefault(key, failure)

    def __str__(self) -> str:
        lines = [f"{sum(self.cases.values())} cases, {len(self.failures)} failures"]
        lines += [
            f"  {key[0]} ({self.failures[key][0]}): {text!a}"[:300]
            for key, text in self.texts.items()
        ]
        return "\n".join(lines)


def run_cases(
    names: Iterable[str], *, seed: int, cases: int | None = None, seconds: float | None = None
) -> Report:
    """Run cases of some targets in turns.

    Args:
        names: of the targets.
        seed: the same seed makes the same cases.
        cases: how many; None = as many as the time allows.
        seconds: how long; None = as long as the cases take.
    """
    report, worker = Report(), Worker()
    end_s = time.monotonic() + (seconds if seconds is not None else float("inf"))
    turns = [TARGETS[name] for name in names for _ in range(TARGETS[name].weight)]
    turn = 0
    try:
        while time.monotonic() < end_s:
            left = TURN if cases is None else min(TURN, cases - sum(report.cases.values()))
            if left <= 0:
                break
            target = turns[turn % len(turns)]
            _turn(target, worker, report, f"{seed} {turn}", left, end_s)
            turn += 1
    finally:
        worker.close()
    return report


def _turn(
    target: Target, worker: Worker, report: Report, seed: str, count: int, end_s: float
) -> None:
    """Run some cases of one target; some are documents of hypothesis, if there are any."""
    rng = random.Random(f"{target.name} {seed}")
    good = worker.members(target.name)
    # Every third turn.
    if target.documents is not None and rng.randrange(3) == 0:
        _documents(target, worker, report, rng, count)
        return
    for _ in range(count):
        if time.monotonic() > end_s:
            return
        member = rng.choice(list(good))
        content = mutate(member, good[member], rng)
        report.add(target.name, member, content, worker.run(target.name, member, content))


def _documents(
    target: Target, worker: Worker, report: Report, rng: random.Random, count: int
) -> None:
    assert target.documents is not None
    member = rng.choice(list(worker.members(target.name)))

    @hypothesis.seed(rng.randrange(2**32))
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        derandomize=False,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(target.documents)
    def each(content: bytes) -> None:
        # Not raised here: the run goes on to other failures.
        report.add(target.name, member, content, worker.run(target.name, member, content))

    each()


def run_parallel(
    names: Iterable[str],
    *,
    seed: int,
    jobs: int,
    cases: int | None = None,
    seconds: float | None = None,
) -> Report:
    """`run_cases` in several processes at once; `cases` is the number of all."""
    reports: list[Report] = []
    chosen = list(names)

    def one(index: int) -> None:
        share = None if cases is None else -(-cases // jobs)
        # Each job starts with another target.
        order = chosen[index * len(chosen) // jobs :] + chosen[: index * len(chosen) // jobs]
        reports.append(run_cases(order, seed=seed * 1000 + index, cases=share, seconds=seconds))

    threads = [threading.Thread(target=one, args=(index,)) for index in range(jobs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    whole = Report()
    for report in reports:
        whole.cases.update(report.cases)
        whole.failures = {**report.failures, **whole.failures}
        whole.texts = {**report.texts, **whole.texts}
    return whole


def keep(report: Report, corpus: Path = CORPUS) -> list[Path]:
    """Write the cases that failed to the corpus; returns their paths."""
    kept = []
    for (target, _), (member, content) in report.failures.items():
        if len(content) > MAX_CORPUS_BYTES:
            continue
        digest = hashlib.sha256(content).hexdigest()[:12]
        path = corpus / target / f"{quote(member, safe='')}.{digest}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        kept.append(path)
    return kept


def replay(names: Iterable[str], corpus: Path = CORPUS) -> Report:
    """Run the cases that failed once."""
    report, worker = Report(), Worker()
    try:
        for name in names:
            for member, content in corpus_cases(name, corpus):
                report.add(name, member, content, worker.run(name, member, content))
    finally:
        worker.close()
    return report


def corpus_cases(target: str, corpus: Path = CORPUS) -> list[tuple[str, bytes]]:
    """Cases of a target that failed once, as file name and content."""
    found = sorted((corpus / target).glob("*"))
    return [(unquote(path.name.rpartition(".")[0]), path.read_bytes()) for path in found]
