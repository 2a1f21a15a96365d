"""ROS parameters: declared from the configuration, checked at start-up, refused in one line."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from rcl_interfaces.msg import ParameterDescriptor

from deworldsg_ros import config as configuration
from deworldsg_ros.ros import parameters as ros_parameters
from deworldsg_ros.ros.options import NodeOptions, Parameters, ReplayOptions, ReplayParameters
from deworldsg_ros.ros.parameters import Field, descriptor, fields
from deworldsg_ros.scene.errors import ConfigurationError

FIELDS = {field.name: field for field in fields()}


def resolve(overrides: dict[str, Any], source: str = "parameters") -> Parameters:
    return ros_parameters.resolve(overrides, source, Parameters)


def complaint(overrides: dict) -> str:
    with pytest.raises(ConfigurationError) as caught:
        resolve(overrides, "lifting_node")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_without_overrides_they_are_the_configuration() -> None:
    parameters = resolve({})
    assert parameters == Parameters()
    defaults = configuration.to_mapping(configuration.Config())
    for section, values in defaults.items():
        assert configuration.to_mapping(getattr(parameters, section)) == values


def test_every_field_of_the_configuration_is_a_parameter() -> None:
    names = {
        f"{section}.{name}"
        for section, values in configuration.to_mapping(configuration.Config()).items()
        for name in values
    }
    assert set(FIELDS) == names | {"debug.faults"} | set(NodeOptions.__struct_fields__)
    replay = {field.name for field in fields(ReplayParameters)}
    assert replay == names | set(ReplayOptions.__struct_fields__)


def test_the_nodes_have_twelve_options_of_their_own() -> None:
    """A new option needs a reason: this number may fall."""
    assert len(NodeOptions.__struct_fields__) + len(ReplayOptions.__struct_fields__) <= 12


@pytest.mark.parametrize("removed", ["queue_size", "patience_s"])
def test_a_removed_option_is_unknown(removed: str) -> None:
    assert f"there is no parameter {removed}" in complaint({removed: 1})


@pytest.mark.parametrize("name", FIELDS)
def test_every_parameter_is_described_and_its_default_is_allowed(name: str) -> None:
    field = FIELDS[name]
    described = descriptor(field)
    assert isinstance(described, ParameterDescriptor)
    assert described.description
    assert described.read_only
    assert type(field.default) is field.kind
    resolve({name: field.default})
    for bounds in (*described.floating_point_range, *described.integer_range):
        assert bounds.from_value <= field.default <= bounds.to_value


def test_overrides_by_full_name() -> None:
    parameters = resolve({"lifting.tau": 0.1, "inputs.world_up": "y", "map_path": "m"})
    assert parameters.lifting.tau == 0.1
    assert parameters.inputs.world_up == "y"
    assert parameters.node.map_path == "m"


def test_a_whole_number_is_a_number() -> None:
    assert resolve({"output.rate_hz": 5}).output.rate_hz == 5.0


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"lifting.tua": 0.1}, "there is no parameter lifting.tua (did you mean lifting.tau?)"),
        ({"savepath": "m"}, "did you mean save_path?"),
        ({"score_treshold": 0.1}, "did you mean perception.score_threshold?"),
        ({"xyzzy": 1}, "there is no parameter xyzzy"),
        ({"lifting.tau": 7.0}, "parameter lifting.tau is 7.0, expected float >= 0 and <= 1"),
        ({"inputs.max_depth_m": 0.0}, "expected float > 0"),
        ({"lifting.tau": "much"}, "is 'much', expected float"),
        ({"output.top_k": 0}, "expected int >= 1 and <= 1000"),
        ({"output.top_k": 2.5}, "expected int"),
        ({"inputs.reliability": "often"}, "expected one of auto, best_effort, reliable"),
        ({"inputs.world_up": True}, "put it in quotes"),
        ({"output.include_surface_points": "yes"}, "expected bool"),
        ({"inputs.world_frame": 3}, "expected str"),
    ],
)
def test_a_bad_override_is_refused_in_one_line(overrides: dict, says: str) -> None:
    text = complaint(overrides)
    assert text.startswith("lifting_node: ")
    assert says in text


def test_open_bounds_become_the_limits_of_the_type() -> None:
    (bounds,) = descriptor(FIELDS["inputs.max_depth_m"]).floating_point_range
    assert (bounds.from_value, bounds.to_value) == (0.0, sys.float_info.max)
    assert descriptor(FIELDS["inputs.max_depth_m"]).additional_constraints == "> 0"
    count = Field("section.count", ("section", "count"), int, 0, "a number without limit", lowest=0)
    (bounds,) = descriptor(count).integer_range
    assert bounds.to_value == 2**63 - 1
