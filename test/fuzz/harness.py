"""Makes cases for the targets, runs them, and keeps the cases that failed."""

from __future__ import annotations

import hashlib
import itertools
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, unquote

from fuzz.targets import TARGETS
from fuzz.worker import Failure, Worker

CORPUS = Path(__file__).resolve().parent / "corpus"
# Larger cases are reported, but not kept in the repository: LARGE_CASES makes them.
MAX_CORPUS_BYTES = 50_000
# By target: file name and content of cases that failed once.
LARGE_CASES: dict[str, list[tuple[str, bytes]]] = {
    "set_option": [("set.txt", b"\n" * 38_712 + b"\0\0\0\x80" + b"\0" * 4 + b"\n" * 61_280)],
}
# Cases of one target before the next one has its turn.
TURN = 25


@dataclass
class Report:
    """What a run found.

    Attributes:
        cases: number of cases by target.
        failures: by target and place in the code, the case that failed first (file name, content).
        texts: by the same, the failure in words.
        seconds: what the cases took, by target.
    """

    cases: Counter[str] = field(default_factory=Counter)
    failures: dict[tuple[str, str], tuple[str, bytes]] = field(default_factory=dict)
    texts: dict[tuple[str, str], str] = field(default_factory=dict)
    seconds: Counter[str] = field(default_factory=Counter)

    def add(self, target: str, failed: Failure | None) -> None:
        """Count a case. A failure counts once for each target and place in the code."""
        self.cases[target] += 1
        if failed is not None:
            key = target, failed.text.split(": ", 2)[1]
            if key not in self.failures:
                self.failures[key] = failed.member, failed.content
                self.texts[key] = failed.text
                print(f"{target} ({failed.member}): {failed.text!a}"[:300], flush=True)

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
    turns = [name for name in names for _ in range(TARGETS[name].weight)]
    try:
        for turn in itertools.count():
            left = TURN if cases is None else min(TURN, cases - sum(report.cases.values()))
            if left <= 0 or time.monotonic() > end_s:
                break
            name = turns[turn % len(turns)]
            began_s = time.monotonic()
            for case in worker.turn(name, f"{seed} {turn}", left):
                report.add(name, case)
            report.seconds[name] += time.monotonic() - began_s
    finally:
        worker.close()
    return report


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
        whole.seconds.update(report.seconds)
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
                report.add(name, worker.run(name, member, content))
    finally:
        worker.close()
    return report


def corpus_cases(target: str, corpus: Path = CORPUS) -> list[tuple[str, bytes]]:
    """Cases of a target that failed once, as file name and content."""
    found = sorted((corpus / target).glob("*"))
    kept = [(unquote(path.name.rpartition(".")[0]), path.read_bytes()) for path in found]
    return kept + LARGE_CASES.get(target, [])
