"""JSON and YAML from outside: every problem of the text is one ValueError, with bounds on depth."""

from __future__ import annotations

import gc
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import msgspec
import yaml

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
    """YAML as plain values; ValueError for other text, aliases, or more than 32 levels.

    ROS parameter files have no aliases either. A few lines of aliases may stand for gigabytes.
    """
    if len(content) > MAX_YAML_BYTES:
        raise ValueError(f"YAML has {len(content)} bytes: expected at most {MAX_YAML_BYTES}")
    try:
        check_yaml(content)
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
