"""PLY files: refusals, and rows that are read as declared."""

import struct

import numpy as np
import pytest

from deworldsg_ros.recordings.folders.annotations import read_vertices
from deworldsg_ros.scene.errors import RecordingError

NAMES = ("x", "id")
FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


def header(form: str = "ascii", count: object = 2, properties: str = "float x\nushort id") -> str:
    lines = "".join(f"property {line}\n" for line in properties.splitlines())
    return f"ply\nformat {form} 1.0\nelement vertex {count}\n{lines}end_header\n"


def rows(form: str, values: list[tuple[float, int]]) -> bytes:
    if form == "ascii":
        return "".join(f"{x!r} {number}\n" for x, number in values).encode()
    order = "<" if form == "binary_little_endian" else ">"
    return b"".join(struct.pack(f"{order}fH", x, number) for x, number in values)


def write(tmp_path, content: bytes):
    path = tmp_path / "points.ply"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("values", [[], [(0.1, 65535), (-2.5, 0)]])
def test_columns_have_the_declared_types(tmp_path, form, values):
    path = write(tmp_path, header(form, len(values)).encode() + rows(form, values))
    columns = read_vertices(path, NAMES)
    assert [columns[name].dtype for name in NAMES] == [np.float32, np.uint16]
    assert columns["x"].tolist() == [float(np.float32(x)) for x, _ in values]
    assert columns["id"].tolist() == [number for _, number in values]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("count", [3, 10**15])
def test_a_count_beyond_the_end_is_refused_before_it_is_allocated(tmp_path, form, count):
    path = write(tmp_path, header(form, count).encode() + rows(form, [(1.0, 1), (2.0, 2)]))
    with pytest.raises(RecordingError, match=f"2 of {count} rows"):
        read_vertices(path, NAMES)


@pytest.mark.parametrize("count_type", ["uchar", "char", "uint"])
@pytest.mark.parametrize("data", [b"", b"\x02", b"\xff\xff\xff\xff\xff"])
def test_lists_that_pass_the_end_of_the_file_are_refused(tmp_path, count_type, data):
    faces = f"element face {10**15}\nproperty list {count_type} int corners\nelement vertex"
    text = header("binary_little_endian", 1).replace("element vertex", faces)
    with pytest.raises(RecordingError, match="element face"):
        read_vertices(write(tmp_path, text.encode() + data), NAMES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no PLY file"),
        ("# a note", "no PLY file"),
        (header().replace("format ascii 1.0\n", ""), "no format"),
        (header().replace("vertex", "corner"), "no element vertex"),
        (header(count=-1), "'element vertex -1'"),
        (header(count="many"), "'element vertex many'"),
        (header(properties="float x\nhalf id"), "'property half id'"),
        (header(properties="float x\nlist float int id"), "'property list float int id'"),
        (header(properties="float x"), "no property id"),
        (header(properties="float x\nlist uchar int id"), "distinct scalars"),
        (header(properties="float x\nint id\nint id"), "distinct scalars"),
        (header() + "1 2\n3\n", "2 numbers"),
        (header() + "1 2\n3 four\n", "2 numbers"),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, text, message):
    path = write(tmp_path, text.encode())
    with pytest.raises(RecordingError, match=message) as caught:
        read_vertices(path, NAMES)
    assert str(path) in str(caught.value)
