"""The configuration that a command runs with: the defaults, a file, single values."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from deworldsg_ros.config import Config, from_mapping, load_config, to_mapping
from deworldsg_ros.scene.errors import ConfigurationError


def effective_config(path: Path | None, settings: list[str] | None = None) -> Config:
    """Configuration of a file (or the defaults) with single values put in.

    Args:
        path: ROS parameter file; None = the defaults.
        settings: ``section.field=value`` each.

    Raises:
        ConfigurationError: names the file or setting, what was seen and what was wanted.
    """
    config = Config() if path is None else load_config(path)
    for setting in settings or []:
        config = _put(config, setting)
    return config


def _put(config: Config, setting: str) -> Config:
    name, equals, text = setting.partition("=")
    section, dot, field = name.strip().partition(".")
    mapping = to_mapping(config)
    if not equals or not dot:
        raise ConfigurationError(f"--set {setting}: wanted section.field=value")
    if field not in mapping.get(section, {}):
        known = ", ".join(mapping.get(section, mapping))
        raise ConfigurationError(f"--set {setting}: there is no {name}; known are {known}")
    mapping[section][field] = _value(text, mapping[section][field])
    try:
        return from_mapping(mapping)
    except ConfigurationError as error:
        described = next(line for path, line in _described_fields() if path == (section, field))
        raise ConfigurationError(f"--set {setting}: no value of {name}, {described}") from error


def _value(text: str, current: Any) -> Any:
    """The value as YAML reads it; what is a string stays one (a bare y is no truth value)."""
    if isinstance(current, str):
        return text
    try:
        value = msgspec.yaml.decode(text.encode())
    except msgspec.MsgspecError:
        return text
    is_whole = isinstance(current, float) and isinstance(value, int)
    return float(value) if is_whole and not isinstance(value, bool) else value


def described_yaml(config: Config) -> str:
    """ROS parameter file of a configuration, each field under its description and range."""
    lines = ["/**:", "  ros__parameters:"]
    mapping = to_mapping(config)
    for (section, field), description in _described_fields():
        if f"    {section}:" not in lines:
            kind = type(getattr(config, section))
            lines += [f"    # {(kind.__doc__ or '').strip()}", f"    {section}:"]
        value = msgspec.yaml.encode(mapping[section][field]).decode()
        # A document that is one plain value ends with a line of three dots.
        lines += [f"      # {description}", f"      {field}: {value.splitlines()[0]}"]
    return "\n".join(lines) + "\n"


def _described_fields() -> Iterator[tuple[tuple[str, str], str]]:
    """Section, field and description of everything that can be configured."""
    sections: Any = msgspec.inspect.type_info(Config)
    for section in sections.fields:
        for field in section.type.fields:
            yield (section.name, field.name), _description(field.type)


def _description(metadata: Any) -> str:
    text = str((metadata.extra_json_schema or {}).get("description", ""))
    kind = metadata.type
    if isinstance(kind, msgspec.inspect.LiteralType):
        return f"{text} [{' | '.join(map(str, kind.values))}]"
    limits = [
        f"{sign} {getattr(kind, name):g}"
        for name, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
        if getattr(kind, name, None) is not None
    ]
    return f"{text} [{', '.join(limits)}]" if limits else text
