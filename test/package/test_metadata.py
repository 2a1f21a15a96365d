"""Package metadata that stands in more than one file agrees."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml
from support.requirements import required

import deworldsg_ros
from deworldsg_ros.config import Config, load_config, to_mapping

ROS_NAMES = r"rclpy|tf2_\w+|launch\w*|ament_\w+|\w+_(msgs|srvs|interfaces)"
# Modules whose distribution has another name.
DISTRIBUTIONS = {
    **{"foxglove": "foxglove-sdk", "zenoh": "eclipse-zenoh", "cv2": "opencv-python-headless"},
    **{"yaml": "pyyaml", "huggingface_hub": "huggingface-hub", "onnx_ir": "onnx-ir"},
}


def test_versions_descriptions_licences_and_ros_packages_agree(root_dir):
    manifest = ElementTree.parse(root_dir / "package.xml").getroot()
    texts = {
        name: (root_dir / name).read_text(encoding="utf-8")
        for name in ("CITATION.cff", "CHANGELOG.md", "pyproject.toml", "setup.py")
    }
    newest = re.search(r"^## \[(\d[^\]]*)\]", texts["CHANGELOG.md"], re.M)
    cited = yaml.safe_load(texts["CITATION.cff"])["version"]
    assert {manifest.findtext("version"), cited, newest[1]} == {deworldsg_ros.__version__}
    described = (manifest.findtext("description") or "").rstrip(".")
    assert f'description = "{described}"' in texts["pyproject.toml"]
    assert manifest.findtext("license") == "Apache-2.0"
    assert 'license="Apache-2.0"' in texts["setup.py"]
    declared = {element.text for element in manifest.findall("exec_depend")}
    imported = {name for name in imported_modules(root_dir) if re.fullmatch(ROS_NAMES, name)}
    # Who runs RTAB-Map has its messages, and nobody else needs them.
    assert {"rclpy", "sensor_msgs"} <= imported - {"rtabmap_msgs"} <= declared


def imported_modules(root: Path) -> set[str]:
    texts = [path.read_text(encoding="utf-8") for path in (root / "deworldsg_ros").rglob("*.py")]
    found = r"^ *(?:from|import) (\w+)(?=[\w.]* import |$| as )"
    return {name for text in texts for name in re.findall(found, text, re.M)}


def test_every_imported_library_is_a_requirement(root_dir):
    extras = ("run", "models", "export", "cluster", "mcp", "networkx")
    extras += ("fleet", "store", "foxglove", "glb", "physics")
    libraries = {
        DISTRIBUTIONS.get(name, name).lower()
        for name in imported_modules(root_dir) - set(sys.stdlib_module_names)
        if name not in ("deworldsg_ros", "__future__") and not re.fullmatch(ROS_NAMES, name)
    }
    assert {"numpy", "msgspec", "torch"} <= libraries
    assert libraries <= {item.name.lower() for item in required(root_dir, *extras)}


@pytest.mark.parametrize(
    "name",
    ["default.yaml", "paper.yaml", "paper_replica.yaml", "paper_rules.yaml", "released.yaml"],
)
def test_a_shipped_configuration_contains_only_changed_values(root_dir, name):
    path = root_dir / "config" / name
    content = yaml.safe_load(path.read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    content.pop("use_sim_time", None)
    assert bool(content) == (name != "default.yaml")
    loaded, default = to_mapping(load_config(path)), to_mapping(Config())
    for section, values in content.items():
        for field, value in values.items():
            assert loaded[section][field] == value != default[section][field], (section, field)


def test_run_time_requirements_are_bounded_and_without_torch(root_dir):
    run_time = required(root_dir, "run")
    names = {item.name for item in run_time}
    assert {"numpy", "scipy", "rosbags"} <= names and not {"torch", "transformers"} & names
    for item in run_time:
        assert sorted(spec.operator for spec in item.specifier) == ["<", ">="], item
    with pytest.raises(subprocess.CalledProcessError):
        required(root_dir, "no-such-extra")
