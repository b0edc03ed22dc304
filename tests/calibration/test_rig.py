"""Rig calibration: a clamped rod with known truth, every wrong connection, what a wiggle leaves open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tiptrace.calibration.rig import RigCalibration, calibrate_rig
from tiptrace.calibration.rig_data import PadTrack, Segment, WiggleCollector
from tiptrace.calibration.rig_pitch import pitch_scale
from tiptrace.calibration.rig_start import check_arrangement
from tiptrace.cli import app
from tiptrace.config import Rig, load_yaml
from tiptrace.errors import CalibrationError
from tiptrace.geometry.transforms import rotation_log
from tiptrace.sim.disturbances import LEVELS, Disturbances, MarkerNoise
from tiptrace.sim.spec import make_spec
from tiptrace.sim.wiggle import Wiggle, WiggleStream
from tiptrace.sim.wiring import FAULTS, Fault
from tiptrace.streams.synchronise import synchronise
from tiptrace.streams.writer import write_recording
from tiptrace.tracer import Sensing
from tiptrace.types import SIDES

DISTURBED = Disturbances(
    markers=MarkerNoise(in_plane_m=2e-5, depth_m=5e-5, shown_depth=0.85),
    shown_shear=0.85,
    T_E_S_rotation_deg=1.5,
    T_E_S_translation_m=8e-4,
    mm_per_px=0.02,
    latency_s=0.06,
    pose_noise_m=2e-5,
    pose_noise_deg=0.01,
)
SPEC = make_spec(mode="markers", seed=11, fps=10.0, disturbances=DISTURBED)


def collect(stream: WiggleStream, untouched: bool = True) -> Segment:
    sensing, collector = Sensing(stream), WiggleCollector("wiggle")
    for observation in synchronise(stream):
        collector.add(observation, sensing(observation))
    places = {s: stream.rig.T_E_S(s)[:3, 3] for s in SIDES}
    return collector.segment(places, stream.untouched if untouched else None)


@pytest.fixture(scope="module")
def wiggle() -> tuple[WiggleStream, Segment]:
    stream = WiggleStream(Wiggle(duration_s=15.0), SPEC)
    return stream, collect(stream)


@pytest.fixture(scope="module")
def result(wiggle: tuple[WiggleStream, Segment]) -> RigCalibration:
    return calibrate_rig([wiggle[1]], wiggle[0].rig)


def test_the_true_rig_is_found(wiggle: tuple[WiggleStream, Segment], result: RigCalibration) -> None:
    stream, _ = wiggle
    for side in SIDES:
        s, true = result.sensors[side], stream.true_rig.sensor(side)
        T = true.T_E_S.matrix()
        assert np.degrees(np.linalg.norm(rotation_log(T[:3, :3].T @ s.T_E_S[:3, :3]))) < 0.5
        assert np.linalg.norm(s.T_E_S[:3, 3] - T[:3, 3]) < 0.3e-3
        np.testing.assert_allclose(s.mm_per_px, true.mm_per_px, rtol=0.005)
        np.testing.assert_allclose(s.gain, [0.85, 0.85, 0.85], atol=0.03)
        assert abs(s.latency_s - 0.06) < 0.003
        assert (
            np.linalg.norm(stream.rig.sensor(side).T_E_S.matrix()[:3, 3] - T[:3, 3]) > 0.7e-3
        )  # it was wrong


def test_the_rig_keeps_its_other_fields(wiggle: tuple[WiggleStream, Segment], result: RigCalibration) -> None:
    old = wiggle[0].rig
    new = Rig.model_validate(result.rig.model_dump())
    assert new.gripper == old.gripper
    assert new.frames == old.frames
    for side in SIDES:
        assert new.sensor(side).marker_threshold == old.sensor(side).marker_threshold
        assert new.sensor(side).calibrated is not None
        assert new.sensor(side).T_E_S_std is not None
        assert new.sensor(side).latency_s == pytest.approx(0.06, abs=0.003)


def test_motion_alone_tells_scale_from_gain(wiggle: tuple[WiggleStream, Segment]) -> None:
    stream, segment = wiggle
    found = calibrate_rig([segment], stream.rig, use_pitch=False)
    for side in SIDES:
        s = found.sensors[side]
        off = s.mm_per_px / np.array(stream.true_rig.sensor(side).mm_per_px) - 1.0
        assert (np.abs(off) < 4.0 * s.mm_per_px_std / s.mm_per_px).all()
    assert any("marker_pitch_mm" in sentence for sentence in found.weak)  # and says that it is weak


def test_a_wrong_pitch_is_told(wiggle: tuple[WiggleStream, Segment]) -> None:
    stream, segment = wiggle
    sensors = {s: stream.rig.sensor(s).model_copy(update={"marker_pitch_mm": 2.6}) for s in SIDES}
    rig = stream.rig.model_copy(update={"sensors": stream.rig.sensors.model_copy(update=sensors)})
    found = calibrate_rig([segment], rig)
    assert any("is marker_pitch_mm right" in sentence for sentence in found.weak)


FAULTY = [f for f in FAULTS if f != "none"]
SAID = {
    "swapped": "left and right are swapped",
    "left-turned": "left sensor: its image is turned by half",
    "both-turned": "both sensors: its image is turned by half",
    "left-depth-inverted": "left sensor: depth is inverted",
    "poses-inverted": "poses are inverted",
}


@pytest.mark.parametrize(
    "fault", [f for f in FAULTY if f in ("swapped", "left-mirrored-x", "poses-inverted")]
)
def test_wrong_connections_are_told(fault: Fault) -> None:
    _check_fault(fault)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTY)
def test_every_wrong_connection_is_told(fault: Fault) -> None:
    _check_fault(fault)


@pytest.mark.slow
def test_rendered_images_give_the_rig(tmp_path: Path) -> None:
    """The whole way of a user: images to MCAP, the packaged gel network, a rig file."""
    disturbances = LEVELS["nominal"].model_copy(update={"mm_per_px": 0.02, "shown_shear": 0.85})
    spec = make_spec(seed=5, disturbances=disturbances)
    stream, recording, out = (
        WiggleStream(Wiggle(duration_s=24.0), spec),
        tmp_path / "w.mcap",
        tmp_path / "rig.yaml",
    )
    write_recording(recording, stream)
    result = CliRunner().invoke(app, ["calibrate", "rig", str(recording), "--out", str(out)])
    assert result.exit_code == 0
    assert "[mm]" in result.output
    for side in SIDES:
        found, true = load_yaml(Rig, out).sensor(side), stream.true_rig.sensor(side)
        T, T_true = found.T_E_S.matrix(), true.T_E_S.matrix()
        assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < 0.3e-3
        assert np.degrees(np.linalg.norm(rotation_log(T_true[:3, :3].T @ T[:3, :3]))) < 0.5
        np.testing.assert_allclose(found.mm_per_px, true.mm_per_px, rtol=0.005)
        assert found.latency_s == pytest.approx(disturbances.latency_s, abs=3e-3)


def _check_fault(fault: Fault) -> None:
    stream = WiggleStream(Wiggle(duration_s=8.0, fault=fault), SPEC)
    about = np.mean([stream.rig.T_E_S(s)[:3, 3] for s in SIDES], axis=0)
    which, _, axis = fault.partition("-mirrored-")
    way = {"x": "left to right", "y": "top to bottom"}.get(axis, "")
    side = "both sensors" if which == "both" else f"{which} sensor"
    expected = SAID.get(fault, f"{side}: its image is mirrored {way}")
    with pytest.raises(CalibrationError, match=expected):
        check_arrangement([collect(stream)], stream.rig, about)


def test_a_hand_that_does_not_turn_is_refused() -> None:
    stream = WiggleStream(Wiggle(duration_s=8.0, rotation_deg=0.0), SPEC)
    with pytest.raises(CalibrationError, match="hardly turns about"):
        calibrate_rig([collect(stream)], stream.rig)


def test_too_short_is_refused() -> None:
    with pytest.raises(CalibrationError, match="at least 50"):
        collect(WiggleStream(Wiggle(duration_s=3.0), SPEC))


def test_the_pitch_of_a_skew_grid_with_a_hole() -> None:
    i, j = np.meshgrid(np.arange(9), np.arange(7))
    grid = np.stack([i.ravel() - 4.0, j.ravel() - 3.0], axis=1)[3:] * 2e-3
    turn = np.radians(4.0)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rest = (grid @ R.T) * [1.02, 0.97]
    pad = PadTrack(np.zeros(1), np.zeros((1, 1, 3)), True, np.zeros(3), rest, True)
    found = pitch_scale(pad, 2.0)
    np.testing.assert_allclose(np.exp(found.log_k), [1.02, 0.97], rtol=1e-3)
    assert np.isinf(pitch_scale(replace(pad, rest=rest[:3]), 2.0).sigma).all()
    assert np.isinf(pitch_scale(pad, None).sigma).all()


def test_from_recording_to_rig_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:  # type: ignore[no-untyped-def]
    import sys

    from tiptrace.cli import main

    stream = WiggleStream(Wiggle(duration_s=8.0), SPEC)
    write_recording(tmp_path / "w.mcap", stream, trial=stream.trial_metadata)
    arguments = [
        "tiptrace",
        "calibrate",
        "rig",
        str(tmp_path / "w.mcap"),
        "--out",
        str(tmp_path / "rig.yaml"),
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    text = capsys.readouterr().out
    assert "T_E_S, x_E [mm]" in text
    assert "±" in text
    new = load_yaml(Rig, tmp_path / "rig.yaml")
    T = stream.true_rig.sensor("left").T_E_S.matrix()
    assert np.linalg.norm(new.T_E_S("left")[:3, 3] - T[:3, 3]) < 0.4e-3
