"""A process that runs cases in limits of memory and time; after a crash a new one takes its place.

`Worker` is the parent's side: `run` returns None, or the failure in words.
"""

from __future__ import annotations

import contextlib
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
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

from fuzz.target import Target

# Processor time of a case, which a busy machine does not change. The slowest good file takes 0.1 s.
CASE_S = 5.0
# After this time, the process waits for something, or hangs in compiled code.
SILENCE_S = 120.0
# Address space of a case above that of the idle process. Every good file is below 1 MB.
CASE_BYTES = 1 << 30
# A new process imports the package and reads the good files of a target first; it may compile.
START_S = 300.0
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


class Worker:
    """Runs cases, one after the other."""

    def __init__(self) -> None:
        self._start()

    def run(self, target: str, member: str, content: bytes) -> Failure | None:
        """Run a case: the good files of a target with another content of one of them.

        Returns:
            None if it was read or refused with a documented error, else the failure.
        """
        (failure,) = self._cases(target, ("run", target, member, content))
        return failure

    def turn(self, target: str, seed: str, count: int) -> Iterator[Failure | None]:
        """Make some cases and run them; one item per case, as `run` returns it.

        The process makes them itself: what damage to a file costs is in its limits too. A case that
        ends the process ends the turn.
        """
        return self._cases(target, ("turn", target, seed, count))

    def members(self, target: str) -> dict[str, bytes]:
        """The good files of a target."""
        self._ready(target)
        return good_files(target, self._folder / target)

    def close(self) -> None:
        """End the process and remove its files."""
        if self._process.is_alive():
            self._process.kill()
        self._process.join(10.0)
        self._connection.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        # Cases are written often: to memory where there is such a folder.
        base = Path("/dev/shm")
        writable = os.access(base, os.W_OK)
        self._folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=base if writable else None))
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._folder), daemon=True)
        self._process.start()
        theirs.close()

    def _ready(self, target: str) -> None:
        """Make the good files of a target, unless they are made."""
        self._connection.send(("ready", target))
        self._answer(START_S)

    def _cases(self, target: str, order: tuple[object, ...]) -> Iterator[Failure | None]:
        member = ""
        try:
            self._ready(target)
            self._connection.send(order)
            while (answer := self._answer(SILENCE_S)) != DONE:
                if isinstance(answer, str):
                    member = answer
                else:
                    yield answer
        except TimeoutError:
            yield self._restart(target, member, f"hang: no answer within {SILENCE_S:.0f} s")
        except (EOFError, ConnectionError):
            self._process.join(10.0)
            text = f"crash: the process ended with {self._process.exitcode}"
            yield self._restart(target, member, text)

    def _answer(self, wait_s: float) -> str | Failure | None:
        if not self._connection.poll(wait_s):
            raise TimeoutError
        answer: str | Failure | None = self._connection.recv()
        return answer

    def _restart(self, target: str, member: str, text: str) -> Failure:
        """Start another process; the content that ended this one is in its folder."""
        path = self._folder / target / member
        failure = Failure(member, path.read_bytes() if path.is_file() else b"", text)
        self.close()
        self._start()
        return failure


def good_files(target: str, folder: Path) -> dict[str, bytes]:
    """Contents of the files that the cases of a target may replace, by name."""
    from fuzz.targets import TARGETS

    return {name: (folder / name).read_bytes() for name in TARGETS[target].members(folder)}


def _serve(connection: Connection, folder: Path) -> None:
    """The process: for each case sends the name of the file, then None or a Failure."""
    with contextlib.suppress(OSError):
        os.nice(5)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _alarm)
    from fuzz.cases import make_cases
    from fuzz.targets import TARGETS

    good: dict[str, dict[str, bytes]] = {}

    def run(name: str, member: str, content: bytes) -> None:
        connection.send(member)
        path = folder / name / member
        path.write_bytes(content)
        text = _outcome(TARGETS[name], folder / name)
        path.write_bytes(good[name][member])
        connection.send(None if text is None else Failure(member, content, text))

    while True:
        try:
            kind, name, *rest = connection.recv()
        except EOFError:
            return
        if kind == "run":
            run(name, *rest)
        elif kind == "turn":
            make_cases(TARGETS[name], good[name], *rest, use=partial(run, name))
        else:
            _set_limit(resource.getrlimit(resource.RLIMIT_AS)[1])
            if name not in good:
                (folder / name).mkdir()
                TARGETS[name].make(folder / name)
                good[name] = good_files(name, folder / name)
                TARGETS[name].read(folder / name)  # they are good; imports and kernels are loaded
            _set_limit(_address_space() + CASE_BYTES)
        connection.send(DONE)


def _outcome(target: Target, place: Path) -> str | None:
    """Read a case; None, or the failure in words."""
    try:
        signal.setitimer(signal.ITIMER_PROF, CASE_S)
        target.read(place)
    except target.errors as error:
        # Errors are shown: their text must be text.
        return _unprintable(str(error))
    except CaseTimeout as error:
        return f"timeout: {_where(error)}"
    except MemoryError as error:
        return f"memory: {_where(error)}"
    except BaseException as error:
        return f"{type(error).__name__}: {_where(error)}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return None


def _unprintable(text: str) -> str | None:
    try:
        text.encode()
    except UnicodeEncodeError:
        return f"error text with lone surrogates: {text[:200]!r}"
    return None


def _alarm(number: int, frame: FrameType | None) -> None:
    raise CaseTimeout


def _set_limit(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (size, resource.getrlimit(resource.RLIMIT_AS)[1]))


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _where(error: BaseException) -> str:
    """The deepest line of this project in a traceback; equal places are one failure."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if f.filename.startswith(str(ROOT)) and "/.venv/" not in f.filename]
    deepest = (own or frames)[-1]
    return f"{Path(deepest.filename).name}:{deepest.lineno} {deepest.name}"
