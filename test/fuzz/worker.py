"""A process that runs cases in limits of memory and time; a new one takes its place if it dies."""

import contextlib
import itertools
import multiprocessing
import os
import resource
import shutil
import signal
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from deworldsg_ros.scene.errors import DeWorldSGError
from fuzz.target import Target

# Processor time of a case, which a busy machine does not change. The slowest good file takes 0.1 s.
CASE_S = 5.0
# After this time without an answer, the process hangs in compiled code, or waits for something. A
# new process imports the package and reads the good files of a target first; it may compile.
SILENCE_S = 300.0
# Address space of a case above that of the idle process. Every good file is below 1 MB.
CASE_BYTES = 1 << 30
# Ends the answers to an order; the name of a file is never empty.
DONE = ""
ROOT = Path(__file__).resolve().parents[2]


class CaseTimeout(BaseException):
    """Not an Exception: no reader may take it for a problem of its file."""


@dataclass(frozen=True)
class Failure:
    """A case that failed: the file, its content, and what happened in words."""

    member: str
    content: bytes
    text: str


# File names with their new contents; or a seed and a number of cases, which the process makes
# itself: what damage to a file costs is in its limits, too.
Cases = list[tuple[str, bytes]] | tuple[str, int]


class Worker:
    def __init__(self) -> None:
        self._start()

    def run(self, target: str, cases: Cases) -> Iterator[Failure | None]:
        """For each case None if it was read, or refused with a DeWorldSGError; else the failure.

        A case that ends the process is the last. No cases: the good files only.
        """
        member = ""
        try:
            self._connection.send((target, cases))
            while (answer := self._answer()) != DONE:
                if isinstance(answer, str):
                    member = answer
                else:
                    yield answer
        except TimeoutError:
            yield self._restart(target, member, f"hang: no answer within {SILENCE_S:.0f} s")
        except (EOFError, ConnectionError):
            self.process.join(10.0)
            yield self._restart(target, member, f"crash: it ended with {self.process.exitcode}")

    def close(self) -> None:
        if self.process.is_alive():
            self.process.kill()
        self.process.join(10.0)
        self._connection.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        # Cases are written often: to memory where there is such a folder.
        base = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        self._folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=base))
        self._connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self._folder), daemon=True)
        self.process.start()
        theirs.close()

    def _answer(self) -> str | Failure | None:
        if not self._connection.poll(SILENCE_S):
            raise TimeoutError
        return self._connection.recv()

    def _restart(self, target: str, member: str, text: str) -> Failure:
        """Start another process; the content that ended this one is in its folder."""
        path = self._folder / target / member
        failure = Failure(member, path.read_bytes() if path.is_file() else b"", text)
        self.close()
        self._start()
        return failure


def _serve(connection: Connection, folder: Path) -> None:
    """The process: for each case sends the name of the file, then None or a Failure."""
    with contextlib.suppress(OSError):
        os.nice(5)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _alarm)
    from fuzz.targets import TARGETS

    goods: dict[str, dict[str, bytes]] = {}
    with contextlib.suppress(EOFError):
        while True:
            name, cases = connection.recv()
            target, place = TARGETS[name], folder / name
            _limit_memory(None)
            if name not in goods:
                place.mkdir()
                goods[name] = target.good_files(place)
                target.read(place / target.file)  # it is good; imports and kernels are loaded
            _limit_memory(CASE_BYTES)
            good = goods[name]

            def run(member: str, content: bytes, target=target, place=place, good=good) -> None:
                connection.send(member)
                (place / member).write_bytes(content)
                text = _outcome(target, place)
                (place / member).write_bytes(good[member])
                connection.send(None if text is None else Failure(member, content, text))

            if isinstance(cases, tuple):
                target.make_cases(good, *cases, use=run)
            else:
                list(itertools.starmap(run, cases))
            connection.send(DONE)


def _outcome(target: Target, place: Path) -> str | None:
    """Read a case; None, or the failure in words."""
    try:
        signal.setitimer(signal.ITIMER_PROF, CASE_S)
        target.read(place / target.file)
    except DeWorldSGError as error:
        # Errors are shown: their text must be text.
        if any("\ud800" <= letter <= "\udfff" for letter in str(error)):
            return f"error text with lone surrogates: {str(error)[:200]!r}"
    except BaseException as error:
        return f"{type(error).__name__}: {_where(error)}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return None


def _alarm(*_: object) -> None:
    raise CaseTimeout


def _limit_memory(above: int | None) -> None:
    """Limit the address space to so many bytes more than now; None = no limit."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = hard if above is None else pages * resource.getpagesize() + above
    resource.setrlimit(resource.RLIMIT_AS, (size, hard))


def _where(error: BaseException) -> str:
    """The deepest line of this project in a traceback; equal places are one failure."""
    frames = traceback.extract_tb(error.__traceback__)
    package = str(ROOT / "deworldsg_ros")  # not the alarm, which is deeper
    own = [frame for frame in frames if frame.filename.startswith(package)]
    deepest = (own or frames)[-1]
    return f"{Path(deepest.filename).name}:{deepest.lineno} {deepest.name}"
