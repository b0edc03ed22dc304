"""A plan's files say what was planned: the tip stays where it is, and the same poses stand in all of them."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from tiptrace.cli import app
from tiptrace.config import Rig, dump_yaml
from tiptrace.errors import OutputError, TipTraceError
from tiptrace.estimation.planning import CANDIDATES, Prediction, Task, predict
from tiptrace.export.anchor_plan import ABORT_RATIO, write_plan
from tiptrace.geometry.transforms import rotation_exp, rotation_from_quaternion
from tiptrace.sim.rig import believed_rig
from tiptrace.sim.rig import true_rig as rig_of
from tiptrace.sim.spec import make_spec

TIP_E = np.array([0.001, -0.002, 0.2])


@pytest.fixture(scope="module")
def task() -> Task:
    spec = make_spec(level="clean")
    return Task(believed_rig(rig_of(spec), spec.disturbed_by, np.random.default_rng(0)), TIP_E)


def plan(task: Task, name: str) -> Prediction:
    return predict(next(w for w in CANDIDATES if w.name == name), task)


def read_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = [[float(v) for v in row.values()] for row in csv.DictReader(path.open())]
    table = np.array(rows)
    return table[:, 1:4], np.array([rotation_from_quaternion(q) for q in table[:, 4:]])


def test_a_two_axis_motion_turns_about_the_nominal_tip(task: Task, tmp_path: Path) -> None:
    write_plan(tmp_path, plan(task, "two-axis"), task, [], picture=False)
    t, R = read_poses(tmp_path / "plan.csv")
    np.testing.assert_allclose(R @ TIP_E + t, np.tile(TIP_E, (len(t), 1)), atol=2e-9)
    angles = np.degrees(np.arccos((np.trace(R, axis1=1, axis2=2) - 1) / 2))
    assert 5.0 < angles.max() < 8.0  # 5° about each of two axes, not at the same time


def test_the_robot_programs_hold_the_same_poses(task: Task, tmp_path: Path) -> None:
    chosen = plan(task, "recommended")
    write_plan(tmp_path, chosen, task, [], picture=False)
    t, R = read_poses(tmp_path / "plan.csv")
    ros = yaml.safe_load((tmp_path / "poses.yaml").read_text())["poses"]
    np.testing.assert_allclose([[p["position"][k] for k in "xyz"] for p in ros], t, atol=1e-8)
    script = (tmp_path / "plan.script").read_text()
    steps = re.findall(r"pose_trans\(start, p\[(.*?)\]\)", script)
    ur = np.array([[float(v) for v in step.split(",")] for step in steps])
    np.testing.assert_allclose(ur[:, :3], t, atol=1e-6)
    np.testing.assert_allclose(rotation_exp(ur[:, 3:]), R, atol=1e-5)
    limit = float(re.search(r"local limit = ([\d.]+)", script)[1])  # type: ignore[index]
    assert limit == pytest.approx(ABORT_RATIO * chosen.force_n, abs=0.01)
    assert np.abs(np.diff(t, axis=0)).max() < 0.05
    assert not t[0].any()
    assert not t[-1].any()


def test_more_motion_promises_more_and_loads_more(task: Task) -> None:
    gentle, recommended, one_axis = (plan(task, n) for n in ("gentle", "recommended", "one-axis"))
    assert (recommended.sigma_m < gentle.sigma_m).all()
    assert recommended.force_n > gentle.force_n
    assert recommended.pad_shear_m > gentle.pad_shear_m
    assert one_axis.worst_sigma_m > 10e-3  # a rotation about one axis leaves the tip free along it


def test_a_gel_that_bears_little_is_told(task: Task) -> None:
    rig = task.rig.model_dump()
    rig["sensors"]["left"]["max_strain_mm"] = 1.0
    weak = replace(task, rig=Rig.model_validate(rig))
    assert not plan(weak, "recommended").within_strain
    assert plan(weak, "two-axis").within_strain


def test_a_place_that_cannot_be_written_is_a_sentence(task: Task, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_plan(tmp_path / "file" / "plan", plan(task, "gentle"), task, [], picture=False)


def test_the_command_writes_all_files_and_names_what_cannot_work(task: Task, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(dump_yaml(task.rig))
    (tmp_path / "tool.yaml").write_text(
        "format: tiptrace-tool/1\ntip_E_m: [0.001, -0.002, 0.2]\ntip_sigma_m: [0.003, 0.003, 0.003]\n"
    )
    run = ["plan-anchor", "--rig", str(tmp_path / "rig.yaml"), "--tool", str(tmp_path / "tool.yaml")]
    result = CliRunner().invoke(app, [*run, "--out", str(tmp_path / "plan")], env={"COLUMNS": "80"})
    assert result.exit_code == 0
    assert "recommended" in result.output
    assert "unobservable" in result.output
    written = {p.name for p in (tmp_path / "plan").iterdir()}
    assert written == {"plan.csv", "plan.script", "poses.yaml", "plan.png"}
    wrong = CliRunner().invoke(app, [*run, "--motion", "dance"])
    assert isinstance(wrong.exception, TipTraceError)
    assert "one-axis" in str(wrong.exception)
