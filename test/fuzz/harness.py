"""Runs cases of the targets in turns, and keeps those that failed."""

import hashlib
import itertools
import threading
import time
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, unquote

from fuzz.targets import TARGETS
from fuzz.worker import Cases, Failure, Worker

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
    """What a run found: numbers of cases by target, what they took, and failures.

    A failure counts once for each target and place in the code.
    """

    cases: Counter[str] = field(default_factory=Counter)
    seconds: Counter[str] = field(default_factory=Counter)
    failures: dict[tuple[str, str], Failure] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def run(self, worker: Worker, name: str, cases: Cases) -> None:
        began_s = time.monotonic()
        found = list(worker.run(name, cases))
        with self._lock:
            self.cases[name] += len(found)
            self.seconds[name] += time.monotonic() - began_s
            for failure in filter(None, found):
                place = failure.text.split(": ", 2)[1]
                if self.failures.setdefault((name, place), failure) is failure:
                    print(f"{name} ({failure.member}): {failure.text!a}"[:300], flush=True)


def run_cases(
    names: Iterable[str],
    *,
    seed: int,
    jobs: int,
    cases: float = float("inf"),
    seconds: float = float("inf"),
) -> Report:
    """Run cases of some targets in turns, at least so many or for so long.

    The same seed makes the same cases, in any number of processes.
    """
    report, end_s = Report(), time.monotonic() + seconds
    order = [name for name in names for _ in range(TARGETS[name].weight)]
    turns = enumerate(itertools.cycle(order))

    def work(_: int) -> None:
        with closing(Worker()) as worker:
            while time.monotonic() < end_s and sum(report.cases.values()) < cases:
                turn, name = next(turns)
                report.run(worker, name, (f"{seed} {turn}", TURN))

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(work, range(jobs)))
    return report


def keep(report: Report, corpus: Path) -> list[Path]:
    """Write the cases that failed to the corpus; returns their paths."""
    kept = []
    for (target, _), failure in report.failures.items():
        if len(failure.content) <= MAX_CORPUS_BYTES:
            digest = hashlib.sha256(failure.content).hexdigest()[:12]
            path = corpus / target / f"{quote(failure.member, safe='')}.{digest}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(failure.content)
            kept.append(path)
    return kept


def corpus_cases(target: str) -> list[tuple[str, bytes]]:
    """Cases of a target that failed once, as file name and content."""
    found = sorted((CORPUS / target).glob("*"))
    kept = [(unquote(path.name.rpartition(".")[0]), path.read_bytes()) for path in found]
    return kept + LARGE_CASES.get(target, [])
