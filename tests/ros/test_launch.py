"""The launch file against the node's parameters; stand-ins for ``launch``, which has no package on PyPI."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tiptrace.ros.node import PARAMETERS

PACKAGE = Path(__file__).parents[2] / "ros2" / "tiptrace_ros"


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    def record(*arguments: Any, **named: Any) -> SimpleNamespace:
        return SimpleNamespace(arguments=arguments, named=named)

    for name, attribute in (
        ("launch", "LaunchDescription"),
        ("launch.actions", "DeclareLaunchArgument"),
        ("launch.substitutions", "LaunchConfiguration"),
        ("launch_ros", ""),
        ("launch_ros.actions", "Node"),
        ("launch_ros.parameter_descriptions", "ParameterValue"),
    ):
        module = ModuleType(name)
        if attribute:
            setattr(module, attribute, record)
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(PACKAGE / "launch" / "tiptrace.launch.py"))


def test_every_parameter_of_the_node_is_an_argument_with_its_default(launch_file: dict[str, Any]) -> None:
    arguments = dict(launch_file["ARGUMENTS"])
    assert arguments.pop("use_sim_time")[:2] == ("false", bool)  # every node of ROS 2 has it
    assert arguments.pop("rig")[:2] == (None, str)
    assert set(arguments) == set(PARAMETERS) - {"rig"}
    for name, (default, kind, what) in arguments.items():
        assert what
        assert kind is type(PARAMETERS[name])
        assert default == (str(PARAMETERS[name]).lower() if kind is bool else str(PARAMETERS[name]))


def test_the_launched_script_is_the_one_that_setup_py_installs(launch_file: dict[str, Any]) -> None:
    *arguments, node = launch_file["generate_launch_description"]().arguments[0]
    assert [a.arguments[0] for a in arguments] == list(launch_file["ARGUMENTS"])
    assert node.named["package"] == "tiptrace_ros"
    assert f"{node.named['executable']} = " in (PACKAGE / "setup.py").read_text().replace("{NAME}", "")
    assert set(node.named["parameters"][0]) == set(launch_file["ARGUMENTS"])
