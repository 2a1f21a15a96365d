"""Backends of other packages, which are found by their entry points.

A package declares, for example:

    [project.entry-points."deworldsg.detectors"]
    my_detector = "my_package.detector:make"

and the configuration names it, with options if it has some: ``perception.detector: my_detector`` or
``"my_detector {threshold: 0.4}"``. Its keyword-only parameters are its options: their annotations
are checked, and may have bounds (``Annotated[float, msgspec.Meta(ge=0)]``).
"""

from __future__ import annotations

import copy
import functools
import inspect
import typing
from collections.abc import Callable, Iterable
from importlib import metadata
from typing import Any

import msgspec
import yaml

# Group of entry points by the parameter that names one of them.
PARAMETERS = {
    "perception.detector": "deworldsg.detectors",
    "perception.segmenter": "deworldsg.segmenters",
    "perception.relation_head": "deworldsg.relation_heads",
    "relations.world_model": "deworldsg.world_models",
    "format": "deworldsg.recordings",
}
# Of the value of a parameter.
MAX_OPTIONS = 10_000


class PluginError(ValueError):
    """A plug-in cannot be used; the text names it."""


def plugins(parameter: str) -> dict[str, metadata.EntryPoint]:
    """The plug-ins that a parameter can name, by their name. Nothing is imported."""
    found = metadata.entry_points(group=PARAMETERS[parameter])
    return {point.name: point for point in sorted(found, key=lambda point: point.name)}


def source_of(point: metadata.EntryPoint) -> str:
    """The package of a plug-in and its version, for people."""
    package = point.dist
    return "an unknown package" if package is None else f"{package.name} {package.version}"


def load_plugin(parameter: str, value: str, known: Iterable[str]) -> Callable[..., Any]:
    """The function that makes a backend, with the options of the parameter's value.

    Args:
        parameter: of `PARAMETERS`.
        value: name, and options as YAML in braces.
        known: names that the package has itself, for the error.

    Raises:
        PluginError: no such plug-in, one that cannot be imported, or options that it refuses.
    """
    name, _, text = value.strip().partition(" ")
    points = plugins(parameter)
    if name not in points:
        names = ", ".join([*known, *points])
        raise PluginError(f"{parameter} is '{value[:60]}': expected one of {names}")
    title = f"{parameter} '{name}' of {source_of(points[name])}"
    try:
        make = points[name].load()
    except Exception as error:  # the code of another package
        raise PluginError(f"{title} cannot be imported: {error}") from error
    if not callable(make):
        raise PluginError(f"{title} is a {type(make).__name__}: expected a function or a class")
    options = _options(make, text, title)
    return functools.partial(make, **options) if options else make


def _options(make: Callable[..., Any], text: str, title: str) -> dict[str, Any]:
    try:
        if len(text) > MAX_OPTIONS:
            raise ValueError(f"{len(text)} characters: expected at most {MAX_OPTIONS}")
        given = yaml.safe_load(text) if text.strip() else {}
        if not isinstance(given, dict):
            raise ValueError(f"'{text[:60]}': expected options as in {{threshold: 0.4}}")
        checked = msgspec.convert(given, _struct(make))
    except (yaml.YAMLError, ValueError) as error:  # msgspec's errors are ValueErrors
        raise PluginError(f"options of {title}: {error}") from error
    return {name: getattr(checked, name) for name in given}


def _struct(make: Callable[..., Any]) -> type[msgspec.Struct]:
    """A struct with the keyword-only parameters of a function."""
    try:
        hints = typing.get_type_hints(
            make.__init__ if inspect.isclass(make) else make, include_extras=True
        )
    except NameError as error:
        raise ValueError(f"an annotation names what is not there: {error}") from error
    fields: list[Any] = []
    for parameter in inspect.signature(make).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            kind = hints.get(parameter.name, Any)
            has_default = parameter.default is not parameter.empty
            default = [
                msgspec.field(default_factory=functools.partial(copy.copy, parameter.default))
            ]
            fields.append((parameter.name, kind, *(default if has_default else [])))
    return msgspec.defstruct("Options", fields, kw_only=True, forbid_unknown_fields=True)
