"""ROS parameters: declared from the configuration, checked at start-up, refused in one line."""

from typing import Any

import pytest
from rcl_interfaces.msg import ParameterDescriptor

from deworldsg_ros.config import Config, to_mapping
from deworldsg_ros.ros import parameters as ros_parameters
from deworldsg_ros.ros.options import NodeOptions, Parameters, ReplayOptions, ReplayParameters
from deworldsg_ros.ros.parameters import descriptor, fields
from deworldsg_ros.scene.errors import ConfigurationError

FIELDS = {field.name: field for field in fields()}


def resolve(overrides: dict[str, Any]) -> Parameters:
    return ros_parameters.resolve(overrides, "lifting_node", Parameters)


def test_every_field_of_the_configuration_is_a_parameter_with_its_default():
    sections = to_mapping(Config())
    names = {f"{section}.{name}" for section, values in sections.items() for name in values}
    assert set(FIELDS) == names | set(NodeOptions.__struct_fields__)
    replay = {field.name for field in fields(ReplayParameters)}
    assert replay == names | set(ReplayOptions.__struct_fields__)
    parameters = resolve({})
    assert parameters == Parameters()
    assert sections == {name: to_mapping(getattr(parameters, name)) for name in sections}


@pytest.mark.parametrize("name", FIELDS)
def test_every_parameter_is_described_and_its_default_is_allowed(name):
    field = FIELDS[name]
    described = descriptor(field)
    assert isinstance(described, ParameterDescriptor)
    assert described.description
    assert described.read_only
    assert type(field.default) is field.kind
    resolve({name: field.default})
    for bounds in (*described.floating_point_range, *described.integer_range):
        assert bounds.from_value <= field.default <= bounds.to_value


def test_overrides_by_full_name():
    overrides = {"lifting.tau": 0.1, "inputs.world_up": "y", "map_path": "m", "output.rate_hz": 5}
    parameters = resolve(overrides)
    assert parameters.lifting.tau == 0.1
    assert parameters.inputs.world_up == "y"
    assert parameters.node.map_path == "m"
    assert parameters.output.rate_hz == 5.0  # a whole number is a number
    assert resolve({"perception.words": None}).perception.words == ()  # [] in a file
    assert resolve({"perception.words": ["red mug"]}).perception.words == ("red mug",)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("lifting.tua", 0.1, "did you mean lifting.tau?"),
        ("score_treshold", 0.1, "did you mean perception.score_threshold?"),
        ("xyzzy", 1, "there is no parameter xyzzy"),
        ("lifting.tau", 7.0, "lifting.tau is 7.0, expected float >= 0 and <= 1"),
        ("inputs.max_depth_m", 0.0, "expected float > 0"),
        ("lifting.tau", "much", "is 'much', expected float"),
        ("output.top_k", 2.5, "expected int >= 1 and <= 1000"),
        ("inputs.reliability", "often", "expected one of auto, best_effort, reliable"),
        ("inputs.world_up", True, "put it in quotes"),
        ("output.include_surface_points", "yes", "expected bool"),
        ("perception.words", "mug", "is 'mug', expected list at most 200 of 1 to 64 characters"),
        ("perception.words", ["mug", "c" * 65], "is ['mug', 'ccc"),
        ("perception.words", ["mug"] * 201, "…, expected list"),
    ],
)
def test_a_bad_override_is_refused_in_one_line(name, value, says):
    with pytest.raises(ConfigurationError) as caught:
        resolve({name: value})
    text = str(caught.value)
    assert text.startswith("lifting_node: ") and "\n" not in text
    assert says in text
