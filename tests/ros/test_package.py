"""The ament package by its files: names agree, and everything that the code imports of ROS 2 is a dependency."""

from __future__ import annotations

import ast
import configparser
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "ros2" / "tiptrace_ros"
NAME = "tiptrace_ros"


@pytest.fixture
def arguments(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What ``setup.py`` gives to setuptools."""
    setuptools = pytest.importorskip("setuptools")
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", lambda **named: given.update(named))
    exec(compile((PACKAGE / "setup.py").read_text(), "setup.py", "exec"), {"__name__": "__main__"})
    return given


def test_name_and_version_are_the_same_everywhere(arguments: dict[str, Any]) -> None:
    package = ET.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("name") == NAME == arguments["name"]
    assert package.findtext("version") == arguments["version"]
    assert package.findtext("license") == arguments["license"]
    assert package.findtext("export/build_type") == "ament_python"
    scripts = configparser.ConfigParser()
    scripts.read(PACKAGE / "setup.cfg")
    assert scripts["install"]["install_scripts"] == scripts["develop"]["script_dir"] == f"$base/lib/{NAME}"


def test_every_installed_file_is_there_and_where_ros_2_looks(arguments: dict[str, Any]) -> None:
    places = dict(arguments["data_files"])
    assert places["share/ament_index/resource_index/packages"] == [f"resource/{NAME}"]
    assert places[f"share/{NAME}"] == ["package.xml"]
    assert f"share/{NAME}/launch" in places
    for files in places.values():
        assert all((PACKAGE / file).is_file() for file in files)


def test_the_entry_point_exists(arguments: dict[str, Any]) -> None:
    (script,) = arguments["entry_points"]["console_scripts"]
    command, module, function = re.fullmatch(r"(\w+) = ([\w.]+):(\w+)", script).groups()  # type: ignore[union-attr]
    assert command == "tiptrace_node"
    tree = ast.parse((PACKAGE / Path(*module.split("."))).with_suffix(".py").read_text())
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_what_the_code_loads_of_ros_2_is_a_dependency() -> None:
    package = ET.parse(PACKAGE / "package.xml").getroot()
    declared = {element.text for element in package.iter("exec_depend")}
    loaded = set()
    for file in (*(ROOT / "src/tiptrace/ros").glob("*.py"), ROOT / "src/tiptrace/drivers/ros2.py"):
        loaded |= set(re.findall(r'load\("(\w+)', file.read_text()))
    launched = set(
        re.findall(r"^from (\w+)", (PACKAGE / "launch/tiptrace.launch.py").read_text(), re.MULTILINE)
    )
    assert "rclpy" in loaded
    assert "launch_ros" in launched
    assert declared == loaded | launched - {"__future__"}
