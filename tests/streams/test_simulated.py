"""The simulated stream: what arrives when, what is wrong on purpose, and that a seed decides everything."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.sim.helpers import short_spec
from tiptrace.config import dump_yaml
from tiptrace.errors import OutputError, SimulationError
from tiptrace.geometry.transforms import rotation_log
from tiptrace.sim.disturbances import LEVELS, Disturbances, MarkerNoise
from tiptrace.sim.simulation import START_NS, Frame
from tiptrace.sim.spec import Lift, TrialSpec, make_spec
from tiptrace.sim.suite import SuiteTrial, suite_trials
from tiptrace.streams.recording import Recording
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.simulated_files import write_suite, write_trial
from tiptrace.types import (
    ImageSample,
    MarkerSample,
    OpeningSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
    TruthSample,
)

QUIET = Disturbances(latency_known=True)


def tiny(**settings: Any) -> TrialSpec:
    return short_spec(**({"anchoring_s": 1.0, "travel_m": 0.004, "disturbances": QUIET} | settings))


def of(samples: list[Sample], kind: type, side: Side | None = None) -> list[Any]:
    return [s for s in samples if isinstance(s, kind) and (side is None or s.side == side)]


@pytest.fixture(scope="module")
def quiet() -> tuple[list[Frame], list[Sample]]:
    frames: list[Frame] = []
    samples = list(SimulatedStream(tiny(), on_frame=frames.append))
    return frames, samples


def test_rates_and_order(quiet: tuple[list[Frame], list[Sample]]) -> None:
    frames, samples = quiet
    left, right, poses = (
        of(samples, MarkerSample, "left"),
        of(samples, MarkerSample, "right"),
        of(samples, PoseSample),
    )
    assert len(left) == len(right) == len(of(samples, TruthSample)) == len(frames)
    np.testing.assert_array_equal(np.diff([s.stamp_ns for s in left]), 40_000_000)
    np.testing.assert_array_equal(np.diff([s.stamp_ns for s in poses]), 8_000_000)
    assert poses[0].stamp_ns < left[0].stamp_ns
    assert poses[-1].stamp_ns > left[-1].stamp_ns + 100_000_000
    assert [s.phase for s in of(samples, PhaseSample)] == [Phase.ANCHORING, Phase.RECONSTRUCTION, Phase.END]
    assert of(samples, PhaseSample)[1].stamp_ns == START_NS + 1_000_000_000
    assert all(s.opening_m == pytest.approx(0.0062) for s in of(samples, OpeningSample))


def test_every_dot_of_the_grid_is_delivered_with_its_identity(
    quiet: tuple[list[Frame], list[Sample]],
) -> None:
    frames, samples = quiet
    for sample in of(samples, MarkerSample):
        assert sample.x_S.shape == (63, 3)
        assert np.all(np.isfinite(sample.x_S))
    rest = frames[0].markers_S["left"]
    assert np.abs(frames[-1].markers_S["left"] - rest).max() < 1.5e-3
    bigger = next(f for f in SimulatedStream(tiny(marker_grid=(8, 10), marker_pitch_m=1.8e-3)).frames())
    x = bigger.markers_S["right"].reshape(8, 10, 3)
    assert np.median(np.diff(x[:, :, 0], axis=1)) == pytest.approx(1.8e-3, rel=0.02)


def test_perfect_markers_in_contact_move_with_the_tool(quiet: tuple[list[Frame], list[Sample]]) -> None:
    """Well inside the patch the shown motion is the tool's rigid motion in the sensor frame."""
    from tiptrace.geometry.kabsch import kabsch

    frames, _ = quiet
    T_E_S = SimulatedStream(tiny()).rig.T_E_S("left")
    for f in frames[5::9]:
        x_0, x_t = (
            (np.c_[m, np.ones(len(m))] @ T_E_S.T)[:, :3]
            for m in (frames[0].markers_S["left"], f.markers_S["left"])
        )
        inside = (np.abs(x_0[:, 1]) < 2.2e-3) & (np.abs(x_0[:, 2] - 0.14) < 6e-3)
        assert inside.sum() >= 15
        tool = f.state.T_E_T @ np.linalg.inv(frames[0].state.T_E_T)
        moved = x_0[inside] @ tool[:3, :3].T + tool[:3, 3]
        assert np.abs(moved - x_t[inside]).max() < 0.06e-3
        found = kabsch(x_0[inside], x_t[inside])
        assert np.degrees(np.linalg.norm(rotation_log(found.R.T @ tool[:3, :3]))) < 0.5


def test_latency_stamps_images_late_and_poses_right(quiet: tuple[list[Frame], list[Sample]]) -> None:
    _, reference = quiet
    late = list(SimulatedStream(tiny(disturbances=QUIET.model_copy(update={"latency_s": 0.08}))))
    for a, b in zip(of(reference, MarkerSample, "left"), of(late, MarkerSample, "left"), strict=True):
        assert b.stamp_ns == a.stamp_ns + 80_000_000
        np.testing.assert_array_equal(a.x_S, b.x_S)
    for a, b in zip(of(reference, PoseSample), of(late, PoseSample), strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.T_B_E, b.T_B_E)


def test_truth_is_the_tip_at_the_exposure(quiet: tuple[list[Frame], list[Sample]]) -> None:
    frames, samples = quiet
    for f, s in zip(frames, of(samples, TruthSample), strict=True):
        assert s.stamp_ns == START_NS + round(f.state.t_s * 1e9)
        np.testing.assert_allclose(s.p_B, (f.state.T_B_E @ f.state.T_E_T)[:3, 3], atol=1e-12)


def measured(noise: MarkerNoise, n: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """n measurements of a still grid of markers, and the truth."""
    from tiptrace.sim.gels import MarkerSensor

    x, y = np.meshgrid(np.arange(-4, 5) * 2e-3, np.arange(-3, 4) * 2e-3)
    true = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1e-3)], axis=1)
    sensor = MarkerSensor(noise, np.ones(2), np.random.default_rng(5))
    return np.array([sensor.measure(true, 0.04 * k) for k in range(n)]), true


def test_white_noise_has_its_size() -> None:
    got, true = measured(MarkerNoise(in_plane_m=3e-5, depth_m=1e-4), 400)
    np.testing.assert_allclose((got - true).std(axis=(0, 1)), [3e-5, 3e-5, 1e-4], rtol=0.03)
    assert np.abs((got - true).mean(axis=(0, 1))).max() < 5e-6


def test_depth_tilt_is_an_ornstein_uhlenbeck_process_of_its_size_and_time() -> None:
    got, true = measured(MarkerNoise(tilt_rad=0.01, tilt_s=1.5), 20000)
    tilt = np.linalg.lstsq(true[:, :2], (got[:, :, 2] - true[:, 2]).T, rcond=None)[0]  # (2, n)
    assert tilt.std() == pytest.approx(0.01, rel=0.15)
    lag = 38  # about 1.5 s
    for t in tilt:
        assert np.corrcoef(t[:-lag], t[lag:])[0, 1] == pytest.approx(np.exp(-lag * 0.04 / 1.5), abs=0.12)


def test_depth_bias_is_constant_and_depth_gain_scales() -> None:
    got, true = measured(MarkerNoise(bias_m=5e-5, shown_depth=0.85), 10)
    assert np.ptp(got, axis=0).max() < 1e-15
    bias = got[0, :, 2] - 0.85 * true[:, 2]
    assert 3.5e-5 < bias.std() < 6.5e-5
    np.testing.assert_array_equal(got[0, :, :2], true[:, :2])


def test_each_disturbance_has_its_switch(quiet: tuple[list[Frame], list[Sample]]) -> None:
    frames, reference = quiet

    def changed(**switch: Any) -> list[Sample]:
        return list(SimulatedStream(tiny(disturbances=QUIET.model_copy(update=switch))))

    poses = [
        np.array([s.T_B_E[:3, 3] for s in of(x, PoseSample)]) for x in (reference, changed(pose_noise_m=5e-5))
    ]
    assert (poses[1] - poses[0]).std() == pytest.approx(5e-5, rel=0.1)
    turned = of(changed(pose_noise_deg=0.03), PoseSample)
    angle = [
        np.linalg.norm(rotation_log(a.T_B_E[:3, :3].T @ b.T_B_E[:3, :3]))
        for a, b in zip(of(reference, PoseSample), turned, strict=True)
    ]
    assert np.degrees(np.sqrt(np.mean(np.square(angle)) / 3)) == pytest.approx(0.03, rel=0.1)
    biased = np.array([s.T_B_E[:3, 3] for s in of(changed(pose_bias_m=1e-3), PoseSample)])
    np.testing.assert_allclose(np.linalg.norm(biased - poses[0], axis=1), 1e-3, rtol=1e-9)
    dropped = of(changed(dropped=0.3), MarkerSample, "left")
    assert 0.4 * len(frames) < len(dropped) < 0.9 * len(frames)
    jitter = np.diff([s.stamp_ns for s in of(changed(jitter_s=0.002), MarkerSample, "left")])
    assert 1.5e6 < jitter.std() < 5e6
    assert of(changed(opening_m=3e-4), OpeningSample)[0].opening_m == pytest.approx(0.0065)
    shown = of(changed(shown_shear=0.85), MarkerSample, "left")
    full = of(reference, MarkerSample, "left")
    motion = [np.abs(x[-1].x_S[:, :2] - x[5].x_S[:, :2]).sum() for x in (shown, full)]
    assert motion[0] == pytest.approx(0.85 * motion[1], rel=0.02)
    scaled = SimulatedStream(tiny(disturbances=QUIET.model_copy(update={"mm_per_px": 0.05})))
    ratio = np.array(scaled.rig.sensor("left").mm_per_px) / 0.0625
    x = of(list(scaled), MarkerSample, "left")[0].x_S[:, :2] / full[0].x_S[:, :2]
    np.testing.assert_allclose(np.median(x, axis=0), ratio, rtol=1e-9)


def test_gel_stiffness_unlike_the_calibrated_one_changes_the_motion() -> None:
    soft = tiny(disturbances=QUIET.model_copy(update={"gel_stiffness": 0.7}), travel_m=0.01)
    frames = [list(SimulatedStream(s).frames())[-1].state for s in (soft, tiny(travel_m=0.01))]
    assert frames[0].pads.normal_n.sum() < 0.8 * frames[1].pads.normal_n.sum()


def test_images_repeat_and_freeze_when_asked() -> None:
    d = QUIET.model_copy(update={"frozen_s": 0.4})
    samples = list(SimulatedStream(tiny(mode="images", disturbances=d, anchoring_s=0.4, travel_m=0.002)))
    left, right = ([s.image for s in of(samples, ImageSample, side)] for side in ("left", "right"))
    same = [np.array_equal(a, b) for a, b in itertools.pairwise(left)]
    assert 8 <= sum(same) <= 11
    assert not any(np.array_equal(a, b) for a, b in itertools.pairwise(right))
    assert left[0].shape == (240, 320, 3)
    assert left[0].dtype == np.uint8


def test_levels_hold_the_values_of_their_table() -> None:
    nominal, hard = LEVELS["nominal"], LEVELS["hard"]
    assert (nominal.markers.in_plane_m, nominal.markers.depth_m) == (0.03e-3, 0.10e-3)
    assert (nominal.markers.tilt_rad, nominal.markers.bias_m) == (0.01, 0.05e-3)
    assert (nominal.shown_shear, nominal.markers.shown_depth) == (0.95, 0.85)
    assert (nominal.T_E_S_rotation_deg, nominal.T_E_S_translation_m, nominal.latency_s) == (1.0, 0.5e-3, 0.04)
    assert (hard.markers.in_plane_m, hard.markers.depth_m) == (0.05e-3, 0.15e-3)
    assert (hard.shown_shear, hard.markers.shown_depth, hard.grasp_drift_deg) == (0.85, 0.60, 3.0)
    assert (nominal.nominal_tip_m, hard.nominal_tip_m) == (3e-3, 8e-3)


def test_believed_rig_is_off_by_the_level_and_the_truth_is_not_in_it() -> None:
    stream = SimulatedStream(short_spec(level="hard", travel_m=0.0))
    truth = stream.trial_metadata["truth"]
    for side in ("left", "right"):
        true = stream.trial_metadata["truth"]["rig"]["sensors"][side]["T_E_S"]
        believed = stream.rig.sensor(side).T_E_S  # type: ignore[arg-type]
        shift = np.subtract(believed.translation_m, true["translation_m"])
        assert np.linalg.norm(shift) == pytest.approx(1e-3, rel=1e-6)
        cosine = abs(np.dot(believed.quaternion_xyzw, true["quaternion_xyzw"]))
        assert np.degrees(2 * np.arccos(min(cosine, 1.0))) == pytest.approx(2.0, rel=1e-3)
        assert stream.rig.sensor(side).latency_s is None  # type: ignore[arg-type]
    assert truth["latency_s"] == 0.08
    assert "truth" not in dump_yaml(stream.rig)
    assert stream.tool is not None
    assert stream.tool.tip_sigma_m == (8e-3, 8e-3, 8e-3)


def test_rig_at_the_reported_opening_is_the_true_one(quiet: tuple[list[Frame], list[Sample]]) -> None:
    """With a thicker tool the fingers stand elsewhere than calibrated; the opening topic says so."""
    stream = SimulatedStream(tiny(thickness_m=0.015))
    opening = of(list(stream), OpeningSample)[0].opening_m
    assert opening == pytest.approx(0.015 - 0.0024)
    assert stream.rig.T_E_S("left", opening)[0, 3] == pytest.approx(0.5 * opening)


def test_same_seed_same_file_bytes_and_another_seed_another_file(tmp_path: Path) -> None:
    digests = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        path = tmp_path / f"{name}.mcap"
        write_trial(tiny(seed=seed, disturbances=None, level="nominal"), path)
        digests.append(hashlib.sha256(path.read_bytes()).hexdigest())
    assert digests[0] == digests[1] != digests[2]


def test_streams_can_be_iterated_twice() -> None:
    stream = SimulatedStream(tiny(mode="images", anchoring_s=0.4, travel_m=0.0, disturbances=None))
    a, b = ([s.image for s in of(list(stream), ImageSample)] for _ in range(2))
    assert len(a) == len(b) > 10
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_recording_round_trip(tmp_path: Path) -> None:
    spec = tiny(seed=7, disturbances=None, level="nominal")
    truth = tmp_path / "truth.parquet"
    frames = write_trial(spec, tmp_path / "t.mcap", truth)
    recording = Recording(tmp_path / "t.mcap")
    stream = SimulatedStream(spec)
    assert recording.rig == stream.rig
    assert recording.trial["spec"]["seed"] == 7
    assert yaml.safe_load(yaml.safe_dump(recording.trial)) == recording.trial
    direct, read = (of(list(x), MarkerSample, "left") for x in (stream, recording))
    assert len(direct) == len(read) == frames
    np.testing.assert_allclose(direct[5].x_S, read[5].x_S, atol=1e-8)
    pq = pytest.importorskip("pyarrow.parquet")
    table = pq.read_table(truth)
    assert table.num_rows == frames
    first = table.slice(0, 1).to_pylist()[0]
    assert len(first["markers_left_S_m"]) == 63 * 3
    assert first["exposure_ns"] == START_NS
    assert first["stamp_left_ns"] == START_NS + 40_000_000


def test_failure_keeps_what_came_before_and_never_the_whole_name(tmp_path: Path) -> None:
    torn = tiny(pushes=({"start_s": 0.5, "duration_s": 0.6, "force_n": (0, 80.0, -300.0)},))
    with pytest.raises(SimulationError, match=r"frame \d+"):
        write_trial(torn, tmp_path / "t.mcap", tmp_path / "truth.parquet")
    assert not (tmp_path / "t.mcap").exists()
    kept = Recording(tmp_path / "t.partial.mcap")
    assert len(of(list(kept), MarkerSample, "left")) > 5
    assert (tmp_path / "truth.parquet").exists()


def test_suite_resumes_and_refuses_another_suites_folder(tmp_path: Path) -> None:
    trials = [SuiteTrial(f"t{k}", tiny(seed=k, travel_m=0.0, anchoring_s=0.4)) for k in range(3)]
    done = list(write_suite(trials[:2], tmp_path))
    assert [d.error for d in done] == [None, None]
    stamp = (tmp_path / "t0.mcap").stat().st_mtime_ns
    (tmp_path / "t2.partial.mcap").write_bytes(b"a run that was killed")
    again = list(write_suite(trials, tmp_path))
    assert [d.frames > 0 for d in again] == [False, False, True]
    assert (tmp_path / "t0.mcap").stat().st_mtime_ns == stamp
    other = [SuiteTrial("t0", tiny(seed=9, travel_m=0.0, anchoring_s=0.4))]
    with pytest.raises(SimulationError, match="other settings"):
        list(write_suite(other, tmp_path))
    before = (tmp_path / "t0.mcap").read_bytes()
    with pytest.raises(
        SimulationError, match="other settings"
    ):  # also where the table of its truth is missing
        list(write_suite(other, tmp_path, truth=True))
    assert (tmp_path / "t0.mcap").read_bytes() == before
    with pytest.raises(OutputError, match="cannot be a folder"):
        list(write_suite(trials, tmp_path / "t0.mcap"))


@pytest.mark.slow
def test_parallel_suite_writes_the_same_bytes(tmp_path: Path) -> None:
    trials = [SuiteTrial(f"t{k}", tiny(seed=k, travel_m=0.0, anchoring_s=0.4)) for k in range(4)]
    for name, workers in (("one", 1), ("two", 2)):
        assert all(d.error is None for d in write_suite(trials, tmp_path / name, workers))
    for trial in trials:
        a, b = ((tmp_path / n / f"{trial.name}.mcap").read_bytes() for n in ("one", "two"))
        assert a == b


def test_suites_are_the_papers() -> None:
    paper, quick = suite_trials("paper"), suite_trials("quick", seed=12)
    assert len(paper) == 51
    assert len({t.name for t in paper}) == 51
    assert len({t.spec.seed for t in paper}) == 51
    assert {t.spec.mode for t in paper} == {"images"}
    assert len(quick) == 12
    assert {t.spec.mode for t in quick} == {"markers"}
    assert min(t.spec.seed for t in quick) >= 1000


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"level": "easy"}, "clean.*nominal.*hard.*unseen"),
        ({"mode": "video"}, "images.*markers"),
        ({"anchor_motion": "wiggle"}, "recommended.*two-axis"),
        ({"colour": "red"}, "valid settings: trajectory"),
        ({"fps": -1}, "fps"),
    ],
)
def test_unknown_settings_list_the_valid_ones(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        make_spec(**settings)


def test_unknown_suite() -> None:
    with pytest.raises(SimulationError, match="paper, quick"):
        suite_trials("all")


def test_lift_shows_in_the_markers() -> None:
    lift = Lift(start_s=0.7, duration_s=0.8, height_m=4e-3)
    spec = tiny(anchoring_s=0.6, anchor_motion="one-axis", travel_m=0.02, lifts=(lift,))
    frames: list[Frame] = []
    list(SimulatedStream(spec, on_frame=frames.append))
    lost = [f for f in frames if not f.state.in_contact]
    assert lost
    held = next(f for f in frames if f.state.in_contact)
    assert np.abs(lost[0].markers_S["left"] - held.markers_S["left"]).max() > 0.2e-3
