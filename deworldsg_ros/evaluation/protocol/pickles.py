"""Official prediction pickles, read without executing their code.

A pickle is a program that names the functions to call. Here each known numpy name resolves to a
placeholder that only stores its arguments, and every other name is refused. The arrays are built
afterwards, after a check of type, shape and length.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Iterable
from typing import Any

import numpy as np

from deworldsg_ros.evaluation.errors import EvaluationError

# An array takes about 20 operations, and an item of a list one.
MAX_OPERATIONS = 10_000_000
# Numbers in all arrays and lists, as often as they are reached: 10^5 points of a thousand segments.
MAX_ITEMS = 300_000_000
_KINDS = frozenset("?biuf")


class _Dtype:
    """Placeholder of numpy.dtype."""

    __slots__ = ("text",)

    def __init__(self, text: Any = "", *_: Any) -> None:
        if isinstance(text, _NumpyClass):
            text = text.name
        if isinstance(text, bytes):
            text = text.decode("ascii", errors="replace")
        if not isinstance(text, str):
            raise EvaluationError(f"pickle has a dtype {text!r}: expected the dtype of a number")
        self.text = text

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if isinstance(order, bytes):
            order = order.decode("ascii", errors="replace")
        if order in ("<", ">") and self.text[:1] not in "<>=|":
            self.text = order + self.text

    def dtype(self) -> np.dtype[Any]:
        try:
            made = np.dtype(self.text)
        except TypeError as error:
            raise EvaluationError(f"pickle has a dtype '{self.text}': unknown") from error
        if made.kind not in _KINDS and made.kind != "b":
            raise EvaluationError(f"pickle has a dtype '{self.text}': expected numbers")
        return made


class _Array:
    """Placeholder of an ndarray, filled by the constructor or by __setstate__."""

    __slots__ = ("buffer", "dtype", "fortran", "shape", "strided")

    def __init__(self, shape: Any = (0,), dtype: Any = "f8", buffer: Any = None, *rest: Any):
        self.shape = shape
        self.dtype = dtype
        self.buffer = buffer
        self.fortran = False
        # Prediction files have no offsets or strides into a shared buffer.
        self.strided = any(item is not None and item != 0 and item != "C" for item in rest)
        if rest[-1:] == ("F",):
            self.fortran, self.strided = True, False

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise EvaluationError("pickle has an array with an unknown state")
        self.shape, self.dtype, fortran, self.buffer = state[-4:]
        self.fortran = bool(fortran)

    def array(self) -> np.ndarray[Any, Any]:
        dtype = (self.dtype if isinstance(self.dtype, _Dtype) else _Dtype(self.dtype)).dtype()
        shape = self.shape if isinstance(self.shape, tuple) else (self.shape,)
        if not all(isinstance(side, int) and side >= 0 for side in shape) or self.strided:
            raise EvaluationError(f"pickle has an array of shape {self.shape!r}")
        data = self.buffer
        if isinstance(data, str):
            data = data.encode("latin1")
        if data is None and math.prod(shape) == 0:
            data = b""
        if isinstance(data, pickle.PickleBuffer):
            data = bytes(data)
        if not isinstance(data, bytes | bytearray):
            raise EvaluationError(f"pickle has an array of {type(data).__name__}: expected bytes")
        if len(data) != math.prod(shape) * dtype.itemsize:
            raise EvaluationError(
                f"pickle has an array of shape {shape} and {len(data)} bytes: expected "
                f"{math.prod(shape) * dtype.itemsize}"
            )
        made = np.frombuffer(data, dtype).reshape(shape, order="F" if self.fortran else "C")
        return made.astype(dtype.newbyteorder("="), copy=True)


class _Callable:
    """A function that a pickle may call. It has no state that a pickle could change."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise EvaluationError("pickle sets the state of a function: refused")


class _NumpyClass(_Callable):
    """An array or number class of numpy; only ndarray and dtype may be called freely."""

    __slots__ = ("name",)

    name: str

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "name", name)

    def __setattr__(self, name: str, value: Any) -> None:
        raise EvaluationError("pickle sets the state of a class: refused")

    def __call__(self, *arguments: Any) -> Any:
        if self.name == "ndarray":
            return _Array(*arguments)
        if self.name == "dtype":
            return _Dtype(*arguments)
        if len(arguments) == 1 and isinstance(arguments[0], int | float):
            return arguments[0]
        raise EvaluationError(f"pickle calls numpy.{self.name}: refused")


class _Reconstruct(_Callable):
    """numpy's _reconstruct(class, shape, type code): an array that __setstate__ fills."""

    __slots__ = ()

    def __call__(self, *_: Any) -> _Array:
        return _Array()


class _FromBuffer(_Callable):
    """numpy's _frombuffer(buffer, dtype, shape, order)."""

    __slots__ = ()

    def __call__(self, buffer: Any, dtype: Any, shape: Any, order: Any = "C", *_: Any) -> _Array:
        made = _Array(shape, dtype, buffer)
        made.fortran = order == "F"
        return made


class _Scalar(_Callable):
    """numpy's scalar(dtype, bytes)."""

    __slots__ = ()

    def __call__(self, dtype: Any, data: Any = None) -> _Array:
        return _Array((), dtype, data)


class _Encode(_Callable):
    """_codecs.encode: bytes in old pickle protocols."""

    __slots__ = ()

    def __call__(self, text: Any, encoding: Any = "latin1") -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise EvaluationError(f"pickle encodes with {encoding!r}: refused")
        return text.encode("latin1")


class _EmptyBytes(_Callable):
    """bytes(): empty bytes in old pickle protocols."""

    __slots__ = ()

    def __call__(self) -> bytes:
        return b""


class _EmptyDict(_Callable):
    """collections.OrderedDict as a plain dictionary."""

    __slots__ = ()

    def __call__(self, *arguments: Any) -> dict[Any, Any]:
        return dict(*arguments)


_CORE = ("numpy.core", "numpy._core")
_NAMES: dict[tuple[str, str], _Callable] = {
    ("_codecs", "encode"): _Encode(),
    ("__builtin__", "bytes"): _EmptyBytes(),
    ("builtins", "bytes"): _EmptyBytes(),
    ("collections", "OrderedDict"): _EmptyDict(),
    **{(f"{core}.multiarray", "_reconstruct"): _Reconstruct() for core in _CORE},
    **{(f"{core}.multiarray", "scalar"): _Scalar() for core in _CORE},
    **{(f"{core}.numeric", "_frombuffer"): _FromBuffer() for core in _CORE},
    **{
        ("numpy", name): _NumpyClass(name)
        for name in (
            "ndarray", "dtype", "bool", "bool_", "int8", "int16", "int32", "int64", "uint8",
            "uint16", "uint32", "uint64", "float16", "float32", "float64",
        )
    },
}  # fmt: skip


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _NAMES[module, name]
        except KeyError:
            raise EvaluationError(
                f"pickle names {module}.{name}: refused; expected only dictionaries, lists, "
                "numbers, text and numpy arrays"
            ) from None

    def persistent_load(self, pid: Any) -> Any:
        raise EvaluationError("pickle refers to an object outside the file: refused")


def load_pickle(content: bytes, source: str) -> Any:
    """Plain containers and numpy arrays of a pickle.

    Args:
        content: the file.
        source: name of the file in errors.

    Raises:
        EvaluationError: the pickle names anything but plain data, or is damaged.
    """
    try:
        _check_operations(content)
        return _Resolver().resolve(_Unpickler(io.BytesIO(content)).load())
    except EvaluationError as error:
        raise EvaluationError(f"{source}: {error}") from error
    # A damaged pickle raises nearly anything.
    except Exception as error:
        raise EvaluationError(
            f"{source} is no readable pickle ({type(error).__name__}: {error})"
        ) from error


def _check_operations(content: bytes) -> None:
    """Refuse programs whose cost is out of proportion to their length.

    The unpickler makes a table as long as the largest memo index: 5 bytes may ask for gigabytes.
    """
    for count, (operation, argument, _) in enumerate(pickletools.genops(content)):
        if count > MAX_OPERATIONS:
            raise EvaluationError(f"pickle has more than {MAX_OPERATIONS} operations")
        is_index = operation.name in ("PUT", "BINPUT", "LONG_BINPUT")
        # Programs that pickle writes count from 0 and store at most one value an operation.
        if is_index and isinstance(argument, int) and argument > count:
            raise EvaluationError(f"pickle has the memo index {argument}")


class _Resolver:
    """Replaces placeholders by arrays. Shared containers stay shared.

    A few lists that contain each other stand for any number of items, and every later step would
    visit them all. So the items are counted as often as they are reached.
    """

    def __init__(self) -> None:
        # By the id of a value: its result, and its number of items; None while it is made.
        self._made: dict[int, tuple[Any, int] | None] = {}

    def resolve(self, value: Any) -> Any:
        """The value with arrays; raises EvaluationError for anything but plain data."""
        return self._resolve(value)[0]

    def _resolve(self, value: Any) -> tuple[Any, int]:
        if value is None or isinstance(value, str | bytes | bool | int | float):
            return value, 1
        if id(value) not in self._made:
            self._made[id(value)] = None
            self._made[id(value)] = self._make(value)
        made = self._made[id(value)]
        if made is None:
            raise EvaluationError("pickle has a container that contains itself")
        return made

    def _make(self, value: Any) -> tuple[Any, int]:
        if isinstance(value, _Array):
            array = value.array()
            return array, 1 + array.size
        if isinstance(value, dict):
            keys, key_size = self._each(value)
            items, item_size = self._each(value.values())
            return dict(zip(keys, items)), key_size + item_size
        if isinstance(value, list | tuple):
            items, size = self._each(value)
            return type(value)(items), size
        raise EvaluationError(f"pickle holds a {type(value).__name__}: refused")

    def _each(self, values: Iterable[Any]) -> tuple[list[Any], int]:
        made = [self._resolve(item) for item in values]
        size = 1 + sum(size for _, size in made)
        if size > MAX_ITEMS:
            raise EvaluationError(f"pickle stands for more than {MAX_ITEMS} items")
        return [item for item, _ in made], size
