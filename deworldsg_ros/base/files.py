"""Files that appear complete or not at all; and files, JSON and YAML from outside."""

from __future__ import annotations

import csv
import errno
import fcntl
import gc
import io
import json
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, TypeVar
from uuid import uuid4

import msgspec
import yaml

# --- JSON and YAML from outside: every problem of the text is one ValueError, with bounds on
# depth.

T = TypeVar("T")

# A configuration has 3 levels. libyaml builds each level by a recursive call in C, without a limit.
MAX_YAML_DEPTH = 32
# The whole configuration with its comments has 12 kB.
MAX_YAML_BYTES = 1_000_000
# Half of a character outside the basic plane; alone it is no text and cannot be printed.
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def parse_json(content: bytes, kind: type[T]) -> T:
    """JSON as a type of msgspec; ValueError for text that is not JSON or not of this type."""
    try:
        return msgspec.json.decode(content, type=kind)
    except RecursionError as error:
        raise ValueError("JSON is nested too deeply") from error
    except msgspec.MsgspecError as error:
        raise ValueError(str(error)) from error


def parse_any_json(content: bytes) -> Any:
    """JSON as Python's json module reads it, with NaN and Infinity; ValueError for other text."""
    try:
        value = json.loads(content)
        if _SURROGATE.search(content):
            json.dumps(value, ensure_ascii=False).encode()
    except RecursionError as error:
        raise ValueError("JSON is nested too deeply") from error
    return value


def parse_yaml(content: bytes) -> Any:
    """YAML as plain values; ValueError for other text, aliases, double keys, more than 32 levels.

    ROS parameter files have no aliases either. A few lines of aliases may stand for gigabytes.
    """
    if len(content) > MAX_YAML_BYTES:
        raise ValueError(f"YAML has {len(content)} bytes: expected at most {MAX_YAML_BYTES}")
    try:
        check_yaml(content)
        _check_keys(yaml.compose(content, Loader=yaml.CSafeLoader))
        value = msgspec.yaml.decode(content)
        msgspec.json.encode(value)
    except Exception as error:  # PyYAML passes errors of the types that it builds on
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error
    return value


def check_yaml(content: bytes) -> None:
    """Raise ValueError for YAML with aliases or more than 32 levels; yaml.YAMLError for others."""
    depth = 0
    for event in yaml.parse(content, Loader=yaml.CSafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"YAML has the alias *{event.anchor}: expected plain values")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_YAML_DEPTH:
            raise ValueError(f"YAML has more than {MAX_YAML_DEPTH} levels")


def _check_keys(node: yaml.Node | None) -> None:
    """Raise ValueError for a key that stands twice: YAML's readers take the last one in silence."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_keys(item)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            _check_keys(value)
            if isinstance(key, yaml.ScalarNode):
                line = key.start_mark.line + 1
                if key.value in lines:
                    raise ValueError(
                        f"the key {key.value!r} is in line {lines[key.value]} and in line {line}: "
                        "expected it once"
                    )
                lines[key.value] = line


@contextmanager
def paused_collector() -> Iterator[None]:
    """Pause the garbage collector while millions of values are made.

    Messages have no cycles. The collector would visit what is there again and again: reading a
    graph of 10^5 nodes takes half as long without it.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


# --- Files that appear complete or not at all, and files from outside, read within bounds.
#
# Everything the package writes goes through `write_atomically` (one file) or `together` (the files
# of one run). Temporary names begin with PREFIX and lie beside their target: a rename is atomic
# only within one file system. Each is locked by its writer. A temporary name without a lock belongs
# to a dead process, and the next writer in that folder removes it, if it is its own user's: others
# may write in the folder, too. What a dead process has left never replaces a file.

PREFIX = ".deworldsg-"
# Suffixes of temporary names: a file or folder in work, and a folder whose files are complete.
PARTIAL, READY = ".partial", ".ready"
_TEMPORARY = re.compile(rf"{re.escape(PREFIX)}[0-9a-f]{{32}}({PARTIAL}|{READY})")
# In a folder whose files are complete: what they replace.
_OLD = ".old"

# Text that spreadsheets may take for a formula, also after blanks and in full-width characters.
_FORMULA = re.compile(r"\s*[=+\-@＝＋－＠]|[\t\r\n]")

Content = bytes | str | Callable[[BinaryIO], object]


def write_atomically(path: Path, content: Content, *, previous: Path | None = None) -> None:
    """Write a file; after a failure, a kill or a power cut, the old file is still there.

    A symbolic link stays: the file that it names is replaced.

    Args:
        path: of the file; its folder exists.
        content: the bytes, text for UTF-8, or a function that writes to an open file.
        previous: name in the same folder under which the old file stays; None = it does not.

    Raises:
        OSError: if the file cannot be written, or the path is no regular file. Errors of `content`
            pass through.
    """
    check_regular(path)
    path = Path(os.path.realpath(path))
    remove_left_overs(path.parent)
    partial, descriptor = _new(path.parent, _make_file)
    with os.fdopen(descriptor, "wb") as file:
        try:
            _write(file, content)
            file.flush()
            os.fsync(file.fileno())
            if previous is not None and path.exists():
                _keep(path, previous)
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    _sync(path.parent)


def csv_text(lines: Iterable[Sequence[object]], end: str = "\r\n") -> str:
    """Lines of cells as CSV; a spreadsheet takes no text of them for a formula.

    A text that could begin one gets an apostrophe, by which spreadsheets know text; text that
    writes a number stays as it is.
    """
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator=end).writerows(map(_as_data, line) for line in lines)
    return text.getvalue()


def _as_data(cell: object) -> object:
    if not isinstance(cell, str) or not _FORMULA.match(cell):
        return cell
    with suppress(ValueError):
        float(cell)
        return cell
    return f"'{cell}"


def write_csv(path: Path, lines: Iterable[Sequence[object]]) -> None:
    """Write lines of cells as a CSV file, as `csv_text`; raises OSError."""
    write_atomically(path, csv_text(lines))


@contextmanager
def together(folder: Path, names: Iterable[str]) -> Iterator[Path]:
    """The files of one run: all of them are put in place at the end, or none.

    A kill never leaves files of two runs side by side: the old files are moved away before the new
    ones are moved in. If that is interrupted, the next writer in the folder undoes or completes it.

    Args:
        folder: for the files; it is made if it is missing. Its other files stay.
        names: of all files that such a run can write. Old files that this run does not write are
            removed.

    Yields:
        a temporary folder, into which the caller writes the files.

    Raises:
        OSError: if something cannot be written. Errors of the block pass through.
    """
    folder.mkdir(parents=True, exist_ok=True)
    folder, names = Path(os.path.realpath(folder)), set(names)
    for name in names:
        check_regular(folder / name)
    with temporary_folder(folder) as staged:
        yield staged
        for path in staged.iterdir():
            _sync(path)
        for name in names - {path.name for path in staged.iterdir()}:
            (staged / name).mkdir()  # stands for "no such file"
        _sync(staged)
        ready = staged.rename(staged.with_suffix(READY))
        _sync(folder)
        try:
            _place(ready)
        except OSError:  # such as a file of another user
            with suppress(OSError):
                _recover(ready)
            raise


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A folder in `parent` that is removed at the end; raises OSError."""
    remove_left_overs(parent)
    folder, descriptor = _new(parent, _make_folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def remove_left_overs(folder: Path) -> None:
    """Complete, undo or remove what dead processes of this user have left in a folder."""
    folder = Path(os.path.realpath(folder))
    with suppress(OSError), _opened(folder) as parent:
        with os.scandir(parent) as entries:
            names = [entry.name for entry in entries if _TEMPORARY.fullmatch(entry.name)]
        for name in names:
            with suppress(OSError), _opened(name, parent) as descriptor:
                _lock(descriptor)
                if _is_own(descriptor) and _is_at(descriptor, folder / name):
                    _recover(folder / name)


def confined(folder: Path, name: str | Path) -> Path:
    """The path of a file that other files name: by a line of an index, or by a link.

    Raises:
        OSError: the path leaves the folder, by its name or by symbolic links.
    """
    path = folder / name
    try:
        root, real = os.path.realpath(folder), os.path.realpath(path)
    except ValueError as error:  # a name with a null byte
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    if os.path.commonpath([root, real]) != root:
        problem = f"it leaves the folder {folder}: copy the file into it"
        raise PermissionError(errno.EPERM, problem, str(path))
    return path


def check_different(files: Iterable[tuple[str, Path]]) -> None:
    """Test that no two files to write are one.

    Args:
        files: what each is, in words, and its path.

    Raises:
        ValueError: two are; the message begins with both.
    """
    seen: dict[str, str] = {}
    for name, path in files:
        real = os.path.realpath(path)
        if real in seen:
            raise ValueError(f"{seen[real]} and {name} are one file, {path}: give another path")
        seen[real] = name


def check_writable(path: Path) -> None:
    """Make the folder of a file and test that `write_atomically` can write there.

    Raises:
        OSError: if it cannot.
    """
    check_regular(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(Path(os.path.realpath(path)).parent):
        pass


class FileLock:
    """The right to write one file, for one process at a time.

    It is a lock of the operating system on a file beside it, so that the end of a process, however
    it ends, releases it.

    Args:
        path: of the file to write; its folder exists.

    Raises:
        BlockingIOError: if a process, this one included, has the right already.
        OSError: if the lock cannot be made.
    """

    # With the process, because a fork inherits the set and not the right.
    _held: ClassVar[set[tuple[int, Path]]] = set()

    def __init__(self, path: Path) -> None:
        self._path = Path(os.path.realpath(path))
        self._file = self._path.with_name(f".{self._path.name}.lock")
        self._descriptor: int | None = None
        while self._descriptor is None:
            descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            try:
                if not _is_own(descriptor):
                    message = f"its lock {self._file} is not this user's own: take another path"
                    raise PermissionError(errno.EPERM, message, path)
                _lock(descriptor)
                # Whoever held it before may have removed the file since it was opened.
                if _is_at(descriptor, self._file):
                    self._descriptor = descriptor
            except BlockingIOError as error:
                owner = os.pread(descriptor, 20, 0).decode(errors="replace") or "?"
                message = f"process {owner} writes it; end that process or take another path"
                raise BlockingIOError(errno.EAGAIN, message, path) from error
            finally:
                if self._descriptor is None:
                    os.close(descriptor)
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, str(os.getpid()).encode(), 0)
        self._held.add((os.getpid(), self._path))

    def __enter__(self) -> FileLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Give the right back; a second call does nothing."""
        if self._descriptor is not None:
            self._held.discard((os.getpid(), self._path))
            self._file.unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = None

    @classmethod
    @contextmanager
    def unless_held(cls, path: Path) -> Iterator[None]:
        """Hold the right during a block, unless this process holds it already."""
        if (os.getpid(), Path(os.path.realpath(path))) in cls._held:
            yield
            return
        with cls(path):
            yield


def open_regular(path: Path, max_bytes: int) -> BinaryIO:
    """Open a file for reading.

    Raises:
        OSError: it cannot be read, is larger than this, or is no regular file: a pipe or a device
            may block, or never end. `strerror` has the reason in words.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for its writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a name with a null byte or half a character
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    status = os.fstat(descriptor)
    problem = ""
    if stat.S_ISDIR(status.st_mode):
        problem = "it is a folder: expected a file"
    elif not stat.S_ISREG(status.st_mode):
        problem = "it is a pipe or a device: expected a regular file"
    elif status.st_size > max_bytes:
        problem = f"it has {status.st_size} bytes: expected at most {max_bytes}"
    if problem:
        os.close(descriptor)
        raise OSError(errno.EINVAL, problem, str(path))
    return os.fdopen(descriptor, "rb")


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Content of a file; errors as `open_regular`."""
    with open_regular(path, max_bytes) as file:
        # Not `read()`: the file may grow without end.
        return file.read(os.fstat(file.fileno()).st_size)


def _write(file: BinaryIO, content: Content) -> None:
    if isinstance(content, str):
        content = content.encode()
    if isinstance(content, bytes):
        file.write(content)
    else:
        content(file)


def _keep(path: Path, name: Path) -> None:
    """Give a file a second name."""
    name.unlink(missing_ok=True)
    try:
        os.link(path, name)
    except OSError:  # a file system without hard links
        write_atomically(name, path.read_bytes())


def _new(folder: Path, make: Callable[[Path], int]) -> tuple[Path, int]:
    """A new locked file or folder with a temporary name, and its descriptor."""
    while True:
        path = folder / f"{PREFIX}{uuid4().hex}{PARTIAL}"
        descriptor = make(path)
        # Until it is locked, another process may take it for a left-over, and remove it.
        with suppress(BlockingIOError):
            _lock(descriptor)
            if _is_at(descriptor, path):
                return path, descriptor
        os.close(descriptor)


def _make_file(path: Path) -> int:
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)


def _make_folder(path: Path) -> int:
    path.mkdir(mode=0o700)
    return os.open(path, os.O_RDONLY)


def _lock(descriptor: int, *, wait: bool = False) -> None:
    """Lock an open file until it is closed; raises BlockingIOError if another holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        # Some network file systems have no locks. Each file is still written whole.
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raise


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file still has this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _is_own(descriptor: int) -> bool:
    """Whether only this user can have made an open file, or put files into an open folder."""
    status = os.fstat(descriptor)
    if stat.S_ISDIR(status.st_mode):
        private = not status.st_mode & 0o077
    else:
        private = stat.S_ISREG(status.st_mode) and status.st_nlink <= 1
    return private and status.st_uid == os.geteuid()


def check_regular(path: Path) -> None:
    """Raise OSError for a path that is there and no regular file; a pipe would block."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder: expected a file", path)
    if path.exists() and not path.is_file():
        problem = "it is a pipe or a device: expected a regular file"
        raise OSError(errno.EINVAL, problem, path)


def _place(ready: Path) -> None:
    """Move complete files to the folder above; the descriptor of `ready` is locked."""
    folder, old = ready.parent, ready / _OLD
    with _opened(folder) as descriptor:
        _lock(descriptor, wait=True)  # two runs that end at one time do not mix
        complete = list(ready.iterdir())
        old.mkdir()
        for path in complete:
            with suppress(FileNotFoundError):
                (folder / path.name).rename(old / path.name)
        _move_files(complete, folder)
        shutil.rmtree(ready)
        _sync(folder)


def _recover(left: Path) -> None:
    """End what a dead process has begun; the descriptor of `left` is locked.

    No file of the folder is replaced: a complete file whose place is taken means that its process
    died while it moved the old files away, and they come back.
    """
    folder = left.parent
    with _opened(folder) as descriptor:
        _lock(descriptor, wait=True)
        if left.suffix == READY:
            new = [path for path in left.iterdir() if path.name != _OLD]
            undo = any(os.path.lexists(folder / path.name) for path in new)
            moved = list((left / _OLD).iterdir()) if undo and (left / _OLD).is_dir() else []
            free = [path for path in moved if not os.path.lexists(folder / path.name)]
            _move_files(free if undo else new, folder)
            _sync(folder)
        if left.is_dir():
            shutil.rmtree(left)
        else:
            left.unlink()


def _move_files(paths: Iterable[Path], folder: Path) -> None:
    """Move regular files; an empty folder stands for "no such file"."""
    for path in paths:
        if stat.S_ISREG(path.lstat().st_mode):
            path.rename(folder / path.name)


@contextmanager
def _opened(path: Path | str, parent: int | None = None) -> Iterator[int]:
    with ExitStack() as stack:
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
        descriptor = os.open(path, flags, dir_fd=parent)
        stack.callback(os.close, descriptor)
        yield descriptor


def _sync(path: Path) -> None:
    """Make the content of a file, or the names in a folder, durable."""
    with _opened(path) as descriptor:
        try:
            os.fsync(descriptor)
        except OSError:
            # Some network file systems cannot sync a folder. Its files are complete without it.
            if not path.is_dir():
                raise
