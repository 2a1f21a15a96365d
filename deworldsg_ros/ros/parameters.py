"""ROS parameters of a node: declared from its typed options, checked, and changed while it runs."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node

from deworldsg_ros.base.words import suggestion
from deworldsg_ros.config import texts_limits
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.scene.errors import ConfigurationError

# --- ROS parameters of a node: declared from its typed options, and checked.

# Parameters that rclpy reads itself.
CLIP_RATE = "relations.max_clips_per_s"
# Characters of a value in an error.
MAX_SHOWN = 500
RCLPY_NAMES = ("use_sim_time", "start_type_description_service")

P = TypeVar("P", bound=msgspec.Struct)


@dataclass(frozen=True)
class Field:
    """One parameter.

    Attributes:
        name: ROS name: ``section.field``, or ``field`` for the section ``node``.
        path: section and field.
        kind: float, int, str, bool or list (of texts).
        default: value without an override.
        description: one line for the user.
        lowest, highest: bounds; None = unbounded.
        lowest_is_open, highest_is_open: whether the bound itself is refused.
        choices: allowed strings; empty = any.
        texts: limits of a list of texts, in words.
    """

    name: str
    path: tuple[str, str]
    kind: type
    default: Any
    description: str
    lowest: float | None = None
    highest: float | None = None
    lowest_is_open: bool = False
    highest_is_open: bool = False
    choices: tuple[str, ...] = ()
    texts: str = ""

    def limits(self) -> str:
        """Allowed values, in words; empty = any."""
        if self.texts:
            return self.texts
        if self.choices:
            return "one of " + ", ".join(self.choices)
        parts = []
        if self.lowest is not None:
            parts.append(f"{'>' if self.lowest_is_open else '>='} {self.lowest:g}")
        if self.highest is not None:
            parts.append(f"{'<' if self.highest_is_open else '<='} {self.highest:g}")
        return " and ".join(parts)


def declare(
    node: Node, kind: type[P], live: Collection[str] = (), foreign: tuple[str, ...] = ()
) -> P:
    """Declare every parameter of a structure on a node; return the values of this start.

    Args:
        node: the node.
        kind: structure of sections.
        live: names of the parameters that can be changed later; the others are read-only.
        foreign: beginnings of names that the node reads itself.

    Raises:
        ConfigurationError: for an unknown name, a wrong type or a value out of range.
    """
    # rclpy has no public access to overrides of parameters that are not declared. Those are the
    # misspelled ones, which have to be refused.
    overrides = {
        name: parameter.value
        for name, parameter in node._parameter_overrides.items()
        if name not in RCLPY_NAMES and not name.startswith(foreign)
    }
    parameters = resolve(overrides, node.get_name(), kind)
    for field in fields(kind):
        value = getattr(getattr(parameters, field.path[0]), field.path[1])
        described = descriptor(field, read_only=field.name not in live)
        node.declare_parameter(field.name, value, described, ignore_override=True)
    return parameters


def resolve(overrides: dict[str, Any], source: str, kind: type[P]) -> P:
    """Validate overrides, by ROS name, into a complete structure.

    Args:
        overrides: values by ROS name.
        source: name of the node, for the error.
        kind: structure of sections.

    Raises:
        ConfigurationError: one line with the parameter, its value and the allowed values.
    """
    known = {field.name: field for field in fields(kind)}
    content: dict[str, dict[str, Any]] = {}
    for name, value in overrides.items():
        field = known.get(name)
        if field is None:
            hint = suggestion(name, known)
            raise ConfigurationError(f"{source}: there is no parameter {name}{hint}")
        section, key = field.path
        content.setdefault(section, {})[key] = _checked(field, value, kind, source)
    return msgspec.convert(content, kind)


def changed(parameters: P, values: dict[str, Any], source: str) -> P:
    """The structure with other values, by ROS name; names of others are left out.

    Raises:
        ConfigurationError: as `resolve`; also for a rate of clips that becomes 0 or was 0, because
            the node then has other inputs.
    """
    for field in fields(type(parameters)):
        if field.name not in values:
            continue
        value = _checked(field, values[field.name], type(parameters), source)
        section, key = field.path
        before = getattr(parameters, section)
        if field.name == CLIP_RATE and bool(value) != bool(getattr(before, key)):
            raise ConfigurationError(
                f"{source}: parameter {field.name} is {getattr(before, key):g}: a change from or "
                "to 0 needs a restart of the node"
            )
        section_after = msgspec.structs.replace(before, **{key: value})
        parameters = msgspec.structs.replace(parameters, **{section: section_after})
    return parameters


def _checked(field: Field, value: Any, kind: type[msgspec.Struct], source: str) -> Any:
    section, key = field.path
    if field.kind is list and value is None:
        value = []  # in a parameter file, an empty list has no type
    try:
        converted = msgspec.convert({section: {key: value}}, kind)
        return getattr(getattr(converted, section), key)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{source}: {_complaint(field, value)}") from error


def fields(kind: type[msgspec.Struct] = Parameters) -> list[Field]:
    """Every parameter of a structure of sections, in its order."""
    return list(_walk(kind))


def descriptor(field: Field, *, read_only: bool = True) -> ParameterDescriptor:
    """ROS description of a parameter."""
    result = ParameterDescriptor(
        description=field.description,
        read_only=read_only,
        additional_constraints=field.limits(),
        # rclpy takes an empty list for one of bytes.
        dynamic_typing=field.kind is list,
    )
    bounded = field.lowest is not None or field.highest is not None
    if field.kind is float and bounded:
        result.floating_point_range = [
            FloatingPointRange(
                from_value=float(-sys.float_info.max if field.lowest is None else field.lowest),
                to_value=float(sys.float_info.max if field.highest is None else field.highest),
            )
        ]
    if field.kind is int and bounded:
        result.integer_range = [
            IntegerRange(
                from_value=int(-(2**63) if field.lowest is None else field.lowest),
                to_value=int(2**63 - 1 if field.highest is None else field.highest),
            )
        ]
    return result


def _walk(struct: type[msgspec.Struct]) -> Iterator[Field]:
    sections: Any = msgspec.inspect.type_info(struct)
    for section in sections.fields:
        for field in section.type.fields:
            metadata = field.type
            path = (section.name, field.name)
            name = field.name if section.name == "node" else ".".join(path)
            description = metadata.extra_json_schema["description"]
            yield _field(name, path, metadata.type, field.default, description)


def _field(name: str, path: tuple[str, str], kind: Any, default: Any, description: str) -> Field:
    inspect = msgspec.inspect
    if isinstance(kind, inspect.LiteralType):
        return Field(name, path, str, default, description, choices=tuple(map(str, kind.values)))
    if isinstance(kind, (inspect.FloatType, inspect.IntType)):
        return Field(
            name,
            path,
            float if isinstance(kind, inspect.FloatType) else int,
            default,
            description,
            lowest=kind.gt if kind.ge is None else kind.ge,
            highest=kind.lt if kind.le is None else kind.le,
            lowest_is_open=kind.gt is not None,
            highest_is_open=kind.lt is not None,
        )
    if isinstance(kind, inspect.VarTupleType):
        return Field(name, path, list, list(default), description, texts=texts_limits(kind))
    return Field(
        name, path, bool if isinstance(kind, inspect.BoolType) else str, default, description
    )


def _complaint(field: Field, value: Any) -> str:
    expected = field.limits() or field.kind.__name__
    if field.kind is not str and field.limits():
        expected = f"{field.kind.__name__} {expected}"
    hint = ""
    if field.kind is str and isinstance(value, bool):
        hint = " (YAML reads a bare y, n, on or off as a boolean: put it in quotes)"
    shown = repr(value) if len(repr(value)) <= MAX_SHOWN else f"{repr(value)[:MAX_SHOWN]}…"
    return f"parameter {field.name} is {shown}, expected {expected}{hint}: {field.description}"


# --- Parameters that change while a node runs.


class LiveParameters:
    """Checks changes and passes them on; rclpy refuses those of read-only parameters.

    Args:
        node: with the attribute `parameters`, and `configure` to take changed ones.
    """

    def __init__(self, node: Any) -> None:
        self._node: Any = node
        ros_node: Node = node
        ros_node.add_on_set_parameters_callback(self._check)
        ros_node.add_post_set_parameters_callback(self._take)

    def _changed(self, parameters: list[Any]) -> Any:
        values = {item.name: item.value for item in parameters}
        return changed(self._node.parameters, values, self._node.get_name())

    def _check(self, parameters: list[Any]) -> SetParametersResult:
        try:
            found = self._changed(parameters)
            if found != self._node.parameters:
                self._node.check(found)
        except ConfigurationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Any]) -> None:
        before = self._node.parameters
        self._node.parameters = self._changed(parameters)
        if self._node.parameters != before:
            self._node.configure()
