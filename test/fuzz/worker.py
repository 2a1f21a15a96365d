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
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

# Time of a case. The slowest good file takes 0.2 s; a busy machine is ten times slower.
CASE_S = 8.0
# After this, the process does not answer to its own alarm: it hangs in compiled code.
SILENCE_S = CASE_S + 7.0
# Address space of a case above that of the idle process. Every good file is below 1 MB.
CASE_BYTES = 1 << 30
# A new process imports the package and reads the good files of a target first; it may compile.
START_S = 300.0
ROOT = Path(__file__).resolve().parents[2]


class CaseTimeout(BaseException):
    """Not an Exception: no reader may take it for a problem of its file."""


class Worker:
    """Runs cases, one after the other."""

    def __init__(self) -> None:
        self._start()

    def run(self, target: str, member: str, content: bytes) -> str | None:
        """Run a case: the good files of a target with another content of one of them.

        Returns:
            None if it was read or refused with a documented error, else the failure.
        """
        try:
            self._send_and_wait((target, None, None), START_S)
            return self._send_and_wait((target, member, content), SILENCE_S)
        except TimeoutError:
            self.close()
            self._start()
            return f"hang: no answer within {SILENCE_S:.0f} s"
        except (EOFError, ConnectionError):
            self._process.join(10.0)
            code = self._process.exitcode
            self.close()
            self._start()
            return f"crash: the process ended with {code}"

    def members(self, target: str) -> dict[str, bytes]:
        """The good files of a target."""
        self._send_and_wait((target, None, None), START_S)
        folder = self._folder / target
        from fuzz.targets import TARGETS

        return {name: (folder / name).read_bytes() for name in TARGETS[target].members(folder)}

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

    def _send_and_wait(
        self, case: tuple[str, str | None, bytes | None], wait_s: float
    ) -> str | None:
        self._connection.send(case)
        if not self._connection.poll(wait_s):
            raise TimeoutError
        answer: str | None = self._connection.recv()
        return answer


def _serve(connection: Connection, folder: Path) -> None:
    """The process: answers each case."""
    with contextlib.suppress(OSError):
        os.nice(5)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, _alarm)
    from fuzz.targets import TARGETS

    ready: set[str] = set()
    while True:
        try:
            name, member, content = connection.recv()
        except EOFError:
            return
        target, place = TARGETS[name], folder / name
        if name not in ready:
            place.mkdir()
            target.make(place)
            target.read(place)  # the good files are good; imports and kernels are loaded
            ready.add(name)
        if member is None:
            connection.send(None)
            continue
        path = place / member
        good = path.read_bytes()
        path.write_bytes(content)
        answer = _answer(target, place)
        path.write_bytes(good)
        connection.send(answer)


def _answer(target, place: Path) -> str | None:  # type: ignore[no-untyped-def]
    try:
        _set_limit(_address_space() + CASE_BYTES)
        signal.setitimer(signal.ITIMER_REAL, CASE_S)
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
        signal.setitimer(signal.ITIMER_REAL, 0)
        _set_limit(resource.getrlimit(resource.RLIMIT_AS)[1])
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
