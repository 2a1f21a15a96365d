"""What the package says of itself in more than one place agrees."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from importlib.metadata import requires, version
from pathlib import Path

import pytest

import deworldsg_ros

ROS_NAMES = r"rclpy|tf2_\w+|launch\w*|ament_\w+|\w+_(msgs|srvs|interfaces)"


def test_versions_agree(root_dir: Path) -> None:
    manifest = ElementTree.parse(root_dir / "package.xml").getroot()
    assert manifest.findtext("version") == deworldsg_ros.__version__
    changelog = (root_dir / "CHANGELOG.md").read_text(encoding="utf-8")
    assert deworldsg_ros.__version__ in changelog or "[Unreleased]" in changelog


def test_package_xml_is_an_ament_python_package_that_depends_on_what_is_imported(
    root_dir: Path,
) -> None:
    manifest = ElementTree.parse(root_dir / "package.xml").getroot()
    assert manifest.findtext("name") == "deworldsg_ros"
    assert manifest.findtext("export/build_type") == "ament_python"
    declared = {element.text for element in manifest.findall("exec_depend")}
    imported = set()
    for path in (root_dir / "deworldsg_ros").rglob("*.py"):
        found = re.findall(r"^ *(?:from|import) (\w+)", path.read_text(encoding="utf-8"), re.M)
        imported |= {name for name in found if re.fullmatch(ROS_NAMES, name)}
    assert imported <= declared


@pytest.mark.parametrize("name", ["default.yaml", "paper.yaml"])
def test_configurations_are_those_of_the_package(root_dir: Path, name: str) -> None:
    from deworldsg_ros.config import load_config

    assert load_config(root_dir / "config" / name)


def test_run_time_requirements_have_one_home_and_no_torch(root_dir: Path) -> None:
    lines = (root_dir / "requirements.txt").read_text(encoding="utf-8").splitlines()
    wanted = {line for line in lines if line and not line.startswith("#")}
    assert all(re.fullmatch(r"[\w.-]+>=[\d.]+,<[\d.]+", line) for line in wanted)
    assert not any(line.startswith(("torch", "transformers")) for line in wanted)


def test_metadata_of_the_installed_package_names_the_requirements(root_dir: Path) -> None:
    if "VIRTUAL_ENV" not in os.environ:
        pytest.skip("deworldsg_ros is installed where scripts/test runs the tests")
    assert version("deworldsg_ros") == deworldsg_ros.__version__
    names = {re.split(r"[<>=!~;\[ ]", line)[0].lower() for line in requires("deworldsg_ros") or []}
    assert {"numpy", "msgspec", "rosbags"} <= names
