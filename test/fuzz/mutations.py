"""Damage to good files: bytes, words, trees, arrays, images and tables, by the kind of the file."""

import copy
import io
import json
import random
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from deworldsg_ros.base.files import check_yaml

Mutation = Callable[[bytes, random.Random], bytes]

# Numbers that a format allows in its text and few programs expect.
NUMBERS = (
    "0", "-0", "-1", "1e400", "-1e400", "1e9999999", "1e308", "1e-320", "nan", "inf", "-inf",
    "NaN", "Infinity", "2147483648", "-2147483649", "9223372036854775808", "1" + "0" * 40,
    "1" * 5000, "0x10", "1_000", "1e", "\u0663", "true", "null", "1000000000000",
)  # fmt: skip
WORDS = (
    "", "x", "$\\foo$", "__PLOTLY__", "[/foo]", "[bold]", "\x00", "\x1b[31m", "../x",
    "../../etc/passwd", "/etc/passwd", "/dev/zero", "\ud800", "\u202e", "<script>alert(1)</script>",
    "'; DROP TABLE", "~", "%s", "{0}", "a" * 10_000, "é" * 300, "\n", "\u2028", "on", "yes",
    "C:\\x",
)  # fmt: skip
INTEGERS = (0, 1, -1, 2**31 - 1, 2**31, -(2**31), 2**32 - 1, 2**63 - 1, -(2**63), 10**12)
FLOATS = (0.0, -0.0, -1.0, 1e-320, 1e30, 1e308, -1e308, np.inf, -np.inf, np.nan, 2.0, 1e19)
VALUES: tuple[Any, ...] = (
    None, True, [], {}, [[]], "x", *WORDS[:10], *INTEGERS, *FLOATS, 10**40, [0] * 300,
)  # fmt: skip
MAX_PLACES = 10_000
# A mutation that would make a case longer is left out.
MAX_CASE_BYTES = 4_000_000


def mutate(name: str, content: bytes, rng: random.Random) -> bytes:
    """Damaged content of a file; its name says which kind of file it is."""
    kinds = BY_SUFFIX.get(Path(name).suffix.lower(), (words,))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        mutation = rng.choice((raw_bytes, *kinds, *kinds, *kinds))
        try:
            damaged = mutation(content, rng)
        except Exception:  # the last mutation left nothing of this kind to damage
            damaged = raw_bytes(content, rng)
        if len(damaged) <= MAX_CASE_BYTES:
            content = damaged
    return content


def raw_bytes(content: bytes, rng: random.Random) -> bytes:
    """Replace bytes by others, by nothing, or by many."""
    at, width = rng.randrange(len(content) + 1), rng.choice((1, 2, 4, 8))
    opening = rng.choice((b"[", b"{", b"(", b"[{", b'{"a":', b"- ", b"\xff", b"\n", b"\x00"))
    new = rng.choice(
        (
            *(b"", rng.randbytes(rng.randrange(1, 16))),
            (rng.choice(INTEGERS) % 256**width).to_bytes(width, rng.choice(("little", "big"))),
            content[at : at + rng.randrange(1, 4096)] * rng.choice((1, 2, 10)),
            opening * rng.choice((1, 10, 5000, 100_000)),
        )
    )
    end = at + rng.choice((0, 1, width, len(new), rng.randrange(64), len(content)))
    return content[:at] + new + content[end:]


def words(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    row, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    parts = lines[row].split(b" ")
    column = rng.randrange(len(parts))
    hostile = rng.choice((*NUMBERS, *WORDS)).encode(errors="surrogatepass")
    times = rng.choice((2, 4, 1000 if len(parts[column]) < 4000 else 2))
    parts[column : column + 1] = rng.choice(([hostile], [hostile], [], [parts[column]] * times))
    lines[other] = rng.choice((lines[other], lines[other], lines[row]))
    lines[row] = b" ".join(parts)
    if rng.randrange(6) == 0:
        del lines[other]
    return b"\n".join(lines)


def json_tree(content: bytes, rng: random.Random) -> bytes:
    return json.dumps(_tree(json.loads(content), rng)).encode(errors="surrogatepass")


def yaml_tree(content: bytes, rng: random.Random) -> bytes:
    """Damage values of a YAML document, or use YAML's own ways to grow one."""
    if rng.randrange(8) == 0:
        rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
        for i in range(1, rng.choice((3, 9, 12))):
            rows.append(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]")
        return content + "\n".join(["", *rows, *["b: &b [*b]"] * rng.randrange(2)]).encode()
    if b"&a0" in content:  # written out, the aliases would fill the memory
        return raw_bytes(content, rng)
    check_yaml(content)  # a mutation before may have nested it so deeply that libyaml crashes
    tree = _tree(yaml.load(content, yaml.CSafeLoader), rng)
    try:
        text = yaml.dump(tree, Dumper=yaml.CSafeDumper, allow_unicode=True)
    except UnicodeEncodeError:  # the dumper in C takes no lone surrogates
        text = yaml.safe_dump(tree, allow_unicode=True)
    return text.encode(errors="surrogatepass")


def _tree(tree: Any, rng: random.Random) -> Any:
    places: list[tuple[Any, Any]] = []
    pending = [tree]
    # Aliases of YAML may stand for any number of places.
    while pending and len(places) < MAX_PLACES:
        node = pending.pop()
        if isinstance(node, (dict, list)):
            inside = list(node.items() if isinstance(node, dict) else enumerate(node))
            places += [(node, key) for key, _ in inside]
            pending += [value for _, value in inside]
    if not places:
        return rng.choice(VALUES)
    node, key = rng.choice(places)
    kind = rng.randrange(6)
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, dict):
        node[rng.choice(WORDS)] = rng.choice((node[key], *VALUES))
    elif kind == 1:
        node[key:key] = [node[key]] * rng.choice((1, 2, 50))
    elif kind == 2:
        other, place = rng.choice(places)
        node[key] = copy.deepcopy(other[place])  # what aliases share stays shared
    elif kind == 3:
        for _ in range(rng.choice((1, 3, 60, 400))):
            node[key] = [node[key]]
    else:
        node[key] = rng.choice(VALUES)
    return tree


def arrays(content: bytes, rng: random.Random) -> bytes:
    """Damage the arrays of an .npz file; its checksums are right again."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = {info.filename: archive.read(info) for info in archive.infolist()}
    name, kind = rng.choice(list(entries)), rng.randrange(8)
    compression = zipfile.ZIP_STORED
    if kind == 0:
        data = entries.pop(name)
        if rng.randrange(2):
            entries[rng.choice((*WORDS[1:5], "../x.npy", name + "x"))] = data
    elif kind == 1:
        entries[name] = raw_bytes(entries[name], rng)
    elif kind == 2:
        compression = rng.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
        entries[name] += bytes(rng.choice((0, 1 << 16)))
    else:
        array = _array(np.load(io.BytesIO(entries[name]), allow_pickle=False), rng)
        np.save(packed := io.BytesIO(), array, allow_pickle=False)
        entries[name] = packed.getvalue()
    with zipfile.ZipFile(packed := io.BytesIO(), "w", compression) as archive:
        for entry, data in entries.items():
            archive.writestr(zipfile.ZipInfo(entry), data, compression)
    return packed.getvalue()


def _array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """An array of another type or shape, or with hostile numbers or those of other places."""
    if array.dtype == np.uint8 and array.ndim == 1 and array.tobytes()[:1] in (b"{", b"["):
        damaged = rng.choice((json_tree, words))(array.tobytes(), rng)
        return np.frombuffer(damaged, np.uint8)
    kind = rng.randrange(8)
    if kind == 0:
        return array.astype(rng.choice(("i1", "i4", "f4", "f8", "u8", "?", "c16", "U3")))
    if kind == 1 or not array.size:
        return np.zeros((*array.shape[:-1], rng.randrange(9)), array.dtype)
    if kind == 2:
        twice = np.concatenate([np.atleast_1d(array)] * 2)
        return twice[: rng.randrange(len(twice))]
    if kind == 3:
        return array.T if array.ndim > 1 else array[None]
    array = array.copy()
    field = array[rng.choice(array.dtype.names)] if array.dtype.names and kind < 7 else array
    places = [np.unravel_index(rng.randrange(field.size), field.shape) for _ in range(4)]
    for place in places[: rng.choice((1, 1, 3))]:
        if rng.randrange(3) == 0:
            field[place] = field[places[3]]
        elif field.dtype.kind == "f":
            field[place] = rng.choice(FLOATS)
        elif field.dtype.kind in "iu":
            limits, near = np.iinfo(field.dtype), int(field[place]) + rng.choice((-1, 1, 2))
            field[place] = min(max(rng.choice((*INTEGERS, near, near)), limits.min), limits.max)
        else:
            field[place] = field.dtype.type(rng.randrange(2))
    if rng.randrange(8) == 0:
        field[...] = field[places[3]]
    return array


def png(content: bytes, rng: random.Random) -> bytes:
    """Damage the chunks of a PNG; their checksums are right again."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append([content[at + 4 : at + 8], content[at + 8 : at + 8 + length]])
        at += length + 12
    chunk = rng.choice(chunks)
    if chunk[0] == b"IHDR" and rng.randrange(2):
        sides = (0, 1, 7, 4000, 65535, 1 << 20, 2**31 - 1)
        chunk[1] = struct.pack(">II", rng.choice(sides), rng.choice(sides)) + chunk[1][8:]
    elif chunk[0] == b"IDAT" and rng.randrange(2):
        chunk[1] = zlib.compress(bytes(rng.choice((0, 10, 1 << 25))))
    else:
        chunk[1] = raw_bytes(chunk[1], rng)
    if rng.randrange(4) == 0:
        rng.shuffle(chunks)
    packed = content[:8]
    for kind, data in chunks:
        packed += struct.pack(">I", len(data)) + kind + data
        packed += struct.pack(">I", zlib.crc32(kind + data))
    return packed


def table(content: bytes, rng: random.Random) -> bytes:
    """Damage a value of an SQLite file, or the name of a column."""
    with tempfile.NamedTemporaryFile(suffix=".db3") as file:
        Path(file.name).write_bytes(content)
        database = sqlite3.connect(file.name)
        run = database.execute
        run("PRAGMA synchronous = OFF")
        (name,) = rng.choice(run("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall())
        column = rng.choice([row[1] for row in run(f"PRAGMA table_info({name})")])
        if rng.randrange(8) == 0:
            run(f"ALTER TABLE {name} RENAME COLUMN {column} TO other")
        else:
            rowid, value = rng.choice(run(f"SELECT rowid, {column} FROM {name}").fetchall())
            values = (*INTEGERS[:-2], *FLOATS, *WORDS[:10], None, rng.randbytes(5))
            damage = isinstance(value, bytes) and rng.randrange(2)
            value = raw_bytes(value, rng) if damage else rng.choice(values)
            run(f"UPDATE {name} SET {column} = ? WHERE rowid = ?", (value, rowid))
        database.commit()
        database.close()
        return Path(file.name).read_bytes()


BY_SUFFIX: dict[str, tuple[Mutation, ...]] = {
    ".map": (arrays,),
    ".npz": (arrays,),
    ".json": (json_tree, json_tree, words),
    ".jsonl": (words,),
    ".yaml": (yaml_tree, words),
    ".png": (png,),
    ".jpg": (raw_bytes,),
    ".pgm": (lambda content, rng: words(content[:40], rng) + content[40:],),
    ".db3": (table,),
    ".mcap": (raw_bytes,),
    ".pkl": (raw_bytes,),
    ".safetensors": (raw_bytes, words),
}
