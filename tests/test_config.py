"""Settings files: what is accepted, and the sentence for what is not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tiptrace.config import Rig, Tool, dump_yaml, load_yaml, parse_yaml
from tiptrace.errors import ConfigError
from tiptrace.geometry.transforms import invert, quaternion_from_rotation, rotation_exp
from tiptrace.types import SIDES

LEFT = {"translation_m": [0.0031, 0.0, 0.140], "quaternion_xyzw": [0, -0.7071068, 0, 0.7071068]}
RIGHT = {"translation_m": [-0.0031, 0.0, 0.140], "quaternion_xyzw": [0.7071068, 0, 0.7071068, 0]}


def rig() -> dict[str, Any]:
    return {
        "format": "tiptrace-rig/1",
        "gripper": {"opening_m": 0.0062, "closing_axis_E": [1, 0, 0]},
        "sensors": {
            "left": {"mm_per_px": [0.0625, 0.0625], "T_E_S": dict(LEFT)},
            "right": {"mm_per_px": [0.0625, 0.0625], "T_E_S": dict(RIGHT)},
        },
    }


def parse(data: dict[str, Any]) -> Rig:
    return parse_yaml(Rig, yaml.safe_dump(data), "rig.yaml")


def test_design_example_is_valid_and_round_trips() -> None:
    parsed = parse(rig())
    assert parse_yaml(Rig, dump_yaml(parsed), "rig.yaml") == parsed
    np.testing.assert_allclose(parsed.T_E_S("left")[:3, 2], [-1, 0, 0], atol=1e-6)  # z_S towards the tool
    np.testing.assert_allclose(parsed.T_E_S("right")[:3, 2], [1, 0, 0], atol=1e-6)


def test_fingers_follow_the_opening() -> None:
    parsed = parse(rig())
    change = parsed.T_E_S("left", 0.0082)[:3, 3] - parsed.T_E_S("left")[:3, 3]
    np.testing.assert_allclose(change, [0.001, 0, 0], atol=1e-12)
    change = parsed.T_E_S("right", 0.0082)[:3, 3] - parsed.T_E_S("right")[:3, 3]
    np.testing.assert_allclose(change, [-0.001, 0, 0], atol=1e-12)
    data = rig()
    data["gripper"]["shift_z_E_m"] = [[0.0, 0.0], [0.01, 0.001]]
    shifted = parse(data)
    np.testing.assert_allclose(shifted.T_E_S("left", 0.0082)[2, 3] - 0.140, 0.0002, atol=1e-12)


def edited(*path: str, value: Any) -> dict[str, Any]:
    data = rig()
    target = data
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return data


def exchanged() -> dict[str, Any]:
    data = rig()
    data["sensors"]["left"]["T_E_S"], data["sensors"]["right"]["T_E_S"] = RIGHT, LEFT
    return data


def inverted() -> dict[str, Any]:
    """T_S_E in place of T_E_S."""
    data = rig()
    for side in SIDES:
        T_S_E = invert(parse(rig()).T_E_S(side))
        data["sensors"][side]["T_E_S"] = {
            "translation_m": T_S_E[:3, 3].tolist(),
            "quaternion_xyzw": quaternion_from_rotation(T_S_E[:3, :3]).tolist(),
        }
    return data


def wxyz() -> dict[str, Any]:
    """A gripper that closes along z_E, the quaternion's w written first.

    With fingers that close along x_E or y_E that mistake is a half turn of both sensors, a mounting that exists;
    there Stage I finds it (tests/estimation/test_arrangement.py).
    """
    data = rig()
    data["gripper"]["closing_axis_E"] = [0, 0, -1]
    for side, z_m in zip(SIDES, (0.1369, 0.1431), strict=True):
        R = rotation_exp([0, np.pi / 2, 0]) @ parse(rig()).T_E_S(side)[:3, :3]
        data["sensors"][side]["T_E_S"]["translation_m"] = [0, 0, z_m]
        x, y, z, w = quaternion_from_rotation(R).tolist()
        data["sensors"][side]["T_E_S"]["quaternion_xyzw"] = [w, x, y, z]
    return data


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": (
        edited("sensors", "left", "mm_pr_px", value=1),
        "unknown key 'sensors.left.mm_pr_px'; valid .*mm_per_px",
    ),
    "unknown top key": (
        edited("gripperr", value=1),
        "unknown key 'gripperr'; valid keys here: format, frames",
    ),
    "not unit": (
        edited("sensors", "left", "T_E_S", "quaternion_xyzw", value=[0, 1, 0, 1]),
        r"not a unit quaternion \(norm 1.414\)",
    ),
    "millimetres": (
        edited("sensors", "left", "T_E_S", "translation_m", value=[3.1, 0, 140]),
        "looks like millimetres",
    ),
    "wxyz": (wxyz(), "do not face each other.*x, y, z, w"),
    "exchanged": (exchanged(), "exchanged"),
    "inverted": (inverted(), "face|away"),
    "format": (edited("format", value="tiptrace-rig/9"), "format"),
    "axis": (edited("gripper", "closing_axis_E", value=[1, 1, 0]), "length 1"),
    "negative scale": (edited("sensors", "left", "mm_per_px", value=[-1, 1]), "greater than 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_rigs_get_one_clear_sentence(case: str) -> None:
    data, message = BAD[case]
    with pytest.raises(ConfigError, match=message) as caught:
        parse(data)
    assert str(caught.value).startswith("rig.yaml: ")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_settings(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_yaml(Rig, tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="not valid YAML"):
        parse_yaml(Tool, "a: [", "tool.yaml")
    with pytest.raises(ConfigError, match="expected a mapping"):
        parse_yaml(Tool, "- 1", "tool.yaml")
    with pytest.raises(ConfigError, match="tip_sigma_m"):
        parse_yaml(Tool, "tip_sigma_m: [3, 3, 5000]", "tool.yaml")


def test_yaml_cannot_make_objects() -> None:
    with pytest.raises(ConfigError, match="not valid YAML"):
        parse_yaml(Tool, "thickness_m: !!python/object/apply:os.getcwd []", "tool.yaml")
