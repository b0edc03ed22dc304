from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tiptrace.errors import ConfigError
from tiptrace.streams.sync_report import SyncReport
from tiptrace.streams.synchronise import LIVE, Synchroniser, SyncSettings, synchronise
from tiptrace.types import (
    SIDES,
    Image,
    ImageSample,
    Observation,
    OpeningSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
)

from .helpers import NS, PERIOD_NS, T0, ListStream, hand_pose, trial_samples

MS = 1_000_000
BLANK: Image = np.zeros((2, 2, 3), dtype=np.uint8)


def image(side: Side, ms: float) -> ImageSample:
    return ImageSample(side, T0 + round(ms * MS), BLANK)


def pose(ms: float) -> PoseSample:
    return PoseSample(T0 + round(ms * MS), hand_pose(T0 + round(ms * MS)))


def poses(start_ms: int, stop_ms: int, step_ms: int = 10) -> list[PoseSample]:
    return [pose(ms) for ms in range(start_ms, stop_ms, step_ms)]


def run(samples: list[Sample], **limits: float) -> tuple[list[Observation], SyncReport]:
    report = SyncReport()
    return list(synchronise(ListStream(samples), SyncSettings(**limits), report)), report


def in_order(images: list[ImageSample]) -> list[Sample]:
    return sorted([*images, *poses(-20, 700)], key=lambda s: s.stamp_ns)


def key(o: Observation) -> tuple[object, ...]:
    return (
        o.left.sample.stamp_ns,
        o.right.sample.stamp_ns,
        o.left.T_B_E.tobytes(),
        o.right.T_B_E.tobytes(),
        o.phase,
        o.opening_m,
        tuple(p.stamp_ns for p in o.poses),
    )


stamps_ms = st.lists(st.integers(0, 600), max_size=25, unique=True)


@settings(deadline=None)
@given(left=stamps_ms, right=stamps_ms)
def test_pairs_are_near_and_use_each_image_once(left: list[int], right: list[int]) -> None:
    samples = in_order([image("left", ms) for ms in left] + [image("right", ms) for ms in right])
    found, report = run(samples)
    used = {side: [o.finger(side).sample.stamp_ns for o in found] for side in SIDES}
    for side, given_ms in zip(SIDES, (left, right), strict=True):
        assert len(set(used[side])) == len(used[side])
        assert set(used[side]) <= {T0 + ms * MS for ms in given_ms}
        assert used[side] == sorted(used[side])
        assert report.unpaired[side] == len(given_ms) - len(found)
    assert all(abs(a - b) <= 20 * MS for a, b in zip(used["left"], used["right"], strict=True))


@settings(deadline=None)
@given(left=stamps_ms, right=stamps_ms)
def test_no_unused_image_is_nearer_than_the_partner(left: list[int], right: list[int]) -> None:
    samples = in_order([image("left", ms) for ms in left] + [image("right", ms) for ms in right])
    found, _ = run(samples)
    pairs = [(o.left.sample.stamp_ns, o.right.sample.stamp_ns) for o in found]
    free_left = {T0 + ms * MS for ms in left} - {a for a, _ in pairs}
    free_right = {T0 + ms * MS for ms in right} - {b for _, b in pairs}
    for a, b in pairs:
        assert all(abs(x - b) >= abs(a - b) for x in free_left)
        assert all(abs(x - a) >= abs(a - b) for x in free_right)


frames_ms = st.lists(st.integers(40, 90), min_size=1, max_size=12).map(
    lambda gaps: list(itertools.accumulate(gaps))
)


@settings(deadline=None)
@given(left=frames_ms, right=frames_ms)
def test_at_camera_rates_nobody_with_a_partner_is_left_alone(left: list[int], right: list[int]) -> None:
    """Frames at most at 25 Hz, some dropped: whoever is left over has nobody free within the limit."""
    samples = in_order([image("left", ms) for ms in left] + [image("right", ms) for ms in right])
    samples += poses(700, 1200)
    found, _ = run(samples)
    free_left = {T0 + ms * MS for ms in left} - {o.left.sample.stamp_ns for o in found}
    free_right = {T0 + ms * MS for ms in right} - {o.right.sample.stamp_ns for o in found}
    assert all(abs(x - y) > 20 * MS for x, y in itertools.product(free_left, free_right))


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_order_of_delivery_does_not_matter_within_the_delay(data: st.DataObject) -> None:
    samples = [s for s in trial_samples(1.2) if not (isinstance(s, ImageSample) and s.stamp_ns % 7 == 3)]
    delays = data.draw(st.lists(st.integers(0, 240 * MS), min_size=len(samples), max_size=len(samples)))
    shuffled = [s for _, s in sorted(zip(delays, samples, strict=True), key=lambda d: d[0] + d[1].stamp_ns)]
    expected, got = run(samples)[0], run(shuffled)[0]
    assert expected
    assert [key(o) for o in got] == [key(o) for o in expected]


@settings(max_examples=30, deadline=None)
@given(
    pose_hz=st.integers(20, 500),
    lag_ms=st.integers(-19, 19),
)
def test_screw_motion_is_reproduced_at_each_exposure(pose_hz: int, lag_ms: int) -> None:
    samples = trial_samples(0.6, pose_hz=pose_hz, right_lag_ns=lag_ms * MS)
    found, _ = run(samples)
    assert len(found) >= 14
    for o in found:
        for finger in (o.left, o.right):
            np.testing.assert_allclose(finger.T_B_E, hand_pose(finger.sample.stamp_ns), atol=1e-9)


def test_a_trial_in_order_gives_every_pair_with_phase_opening_and_poses() -> None:
    samples = trial_samples(2.0)
    found, report = run(samples)
    assert len(found) == report.pairs == 50
    assert report.sentences() == []
    assert [o.phase for o in found] == [Phase.ANCHORING] * 25 + [Phase.RECONSTRUCTION] * 25
    assert all(o.stamp_ns == T0 + k * PERIOD_NS + 1_500_000 for k, o in enumerate(found))
    expected = [0.006 + 1e-5 * ((o.stamp_ns - T0) // (NS // 10)) for o in found]
    np.testing.assert_allclose([o.opening_m or 0.0 for o in found], expected)
    handed = [p.stamp_ns for o in found for p in o.poses]
    last = found[-1].right.sample.stamp_ns
    assert handed == [s.stamp_ns for s in samples if isinstance(s, PoseSample) and s.stamp_ns <= last]


def test_no_pose_is_extrapolated_or_taken_across_a_gap() -> None:
    images = [image(side, ms) for ms in range(0, 1000, 40) for side in SIDES]
    holey = [*poses(100, 401), *poses(700, 901)]  # begins late, pauses for 300 ms, ends early
    found, report = run(sorted([*images, *holey], key=lambda s: s.stamp_ns))
    stamps = {(o.stamp_ns - T0) // MS for o in found}
    assert stamps == {ms for ms in range(0, 1000, 40) if 100 <= ms <= 400 or 700 <= ms <= 900}
    assert report.pairs_without_pose == 25 - len(found)
    (event,) = report.gaps  # the poses begin and end within 0.2 s of the images
    assert (event.kind, event.start_ns, event.end_ns) == ("pose-gap", T0 + 440 * MS, T0 + 680 * MS)
    text = " ".join(report.sentences())
    assert "begin before the robot's poses" in text
    assert "pause for 0.30 s" in text
    assert "go on after the robot's poses" in text


def test_poses_that_end_for_good_are_an_event() -> None:
    images = [image(side, ms) for ms in range(0, 2000, 40) for side in SIDES]
    found, report = run(sorted([*images, *poses(-10, 1001)], key=lambda s: s.stamp_ns))
    assert len(found) == 26
    (event,) = report.gaps
    assert (event.start_ns, event.end_ns) == (T0 + 1040 * MS, T0 + 1960 * MS)
    assert report.pairs_without_pose == 24


def test_a_gap_below_the_limit_is_interpolated() -> None:
    found, report = run([image("left", 95), image("right", 95), pose(0), pose(190)])
    assert len(found) == 1
    assert report.sentences() == []
    found, report = run([image("left", 95), image("right", 95), pose(0), pose(190)], max_pose_gap_s=0.15)
    assert not found


def test_repeated_and_late_images_are_left_out_and_counted() -> None:
    samples = [image(side, ms) for ms in range(0, 2000, 40) for side in SIDES]
    samples = [*samples, image("left", 80), image("right", 1960)]  # long gone; repeated
    found, report = run([*poses(-10, 2100), *samples])
    assert len(found) == 50
    assert report.late["left"] + report.repeated["left"] == 1
    assert report.repeated["right"] == 1
    assert any("repeat a stamp" in sentence for sentence in report.sentences())


def test_phase_is_none_before_the_first_mark_and_without_marks() -> None:
    images = [image(side, ms) for ms in (0, 40, 80) for side in SIDES]
    found, _ = run([*images, *poses(-10, 110)])
    assert [o.phase for o in found] == [None, None, None]
    found, _ = run([*images, *poses(-10, 110), PhaseSample(T0 + 30 * MS, Phase.ANCHORING)])
    assert [o.phase for o in found] == [None, Phase.ANCHORING, Phase.ANCHORING]
    assert [o.opening_m for o in found] == [None, None, None]


def test_live_gives_a_pair_as_soon_as_its_poses_are_in() -> None:
    synchroniser = Synchroniser(LIVE)
    arrivals: list[tuple[int, Sample]] = []
    for ms in range(0, 1000, 40):  # images arrive 12 ms after capture, poses 1 ms
        arrivals += [(ms + 12, image("left", ms)), (ms + 15, image("right", ms + 3))]
    arrivals += [(ms + 1, pose(ms)) for ms in range(-10, 1020, 8)]
    waited = []
    for now_ms, sample in sorted(arrivals, key=lambda a: a[0]):
        waited += [now_ms - (o.right.sample.stamp_ns - T0) // MS for o in synchroniser.push(sample)]
    assert len(waited) == 25
    assert max(waited) <= 12


@pytest.mark.parametrize("missing", ["right", "poses", "both"])
def test_memory_is_bounded_when_a_part_of_the_rig_falls_silent(missing: str) -> None:
    synchroniser = Synchroniser()
    sizes = []
    for ms in range(0, 120_000, 40):
        batch: list[Sample] = [image("left", ms), OpeningSample(T0 + ms * MS, 0.006)]
        if missing == "poses":
            batch.append(image("right", ms))
        if missing == "right":
            batch += poses(ms, ms + 40, 8)
        for sample in batch:
            assert not list(synchroniser.push(sample))
        held = len(synchroniser._images["left"]) + len(synchroniser._images["right"])
        held += len(synchroniser._pairs) + len(synchroniser._openings) + len(synchroniser._track._samples)
        sizes.append(held)
    assert max(sizes) < 1500
    assert max(sizes[1000:]) <= max(sizes[:1000]) + 1


def test_settings_that_cannot_work_are_refused() -> None:
    with pytest.raises(ConfigError, match="negative"):
        SyncSettings(max_pair_gap_s=-1)
    with pytest.raises(ConfigError, match="max_lag_s"):
        SyncSettings(max_lag_s=0.1)
