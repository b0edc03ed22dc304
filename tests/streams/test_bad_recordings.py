"""Every recording that cannot give a right trajectory is refused in one sentence: file, topic, remedy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiptrace.config import dump_yaml
from tiptrace.errors import RecordingError, TipTraceError
from tiptrace.geometry.transforms import rotation_exp, transform
from tiptrace.streams import messages
from tiptrace.streams.recording import Recording
from tiptrace.streams.synchronise import synchronise
from tiptrace.streams.topics import (
    FRAME_ID,
    IMAGE_TOPIC,
    MARKER_TOPIC,
    OPENING_TOPIC,
    PHASE_TOPIC,
    POSE_TOPIC,
    TRUTH_TOPIC,
)
from tiptrace.streams.writer import write_recording
from tiptrace.types import SIDES, FloatArray, ImageSample, PoseSample

from .helpers import NS, SIZE, T0, ListStream, hand_pose, make_rig, texture, trial_samples, write_raw

Row = tuple[str, str, int, dict[str, Any]]
RIG = {"rig__yaml": dump_yaml(make_rig()).encode()}
IMAGE, POSE = "sensor_msgs/msg/CompressedImage", "geometry_msgs/msg/PoseStamped"


def pose_row(k: int, T_B_E: FloatArray | None = None, frame_id: str = "base") -> Row:
    stamp = T0 + k * NS // 100
    message = messages.pose_message(hand_pose(stamp) if T_B_E is None else T_B_E, stamp, frame_id)
    return POSE_TOPIC, POSE, stamp, message


def rows() -> list[Row]:
    """A sound trial of one second."""
    found: list[Row] = [(PHASE_TOPIC, "std_msgs/msg/String", T0 - NS // 50, {"data": "anchoring"})]
    for k in range(-2, 103):
        found.append(pose_row(k))
        if k % 4 == 0 and 0 <= k < 100:
            stamp = T0 + k * NS // 100
            found += [
                (
                    IMAGE_TOPIC[side],
                    IMAGE,
                    stamp,
                    messages.compressed_message(texture(k), stamp, FRAME_ID[side], "jpeg", 95),
                )
                for side in SIDES
            ]
    found.append((PHASE_TOPIC, "std_msgs/msg/String", T0 + NS // 2, {"data": "reconstruction"}))
    return found


def edited(topic: str, edit: Callable[[Row], Row | None]) -> list[Row]:
    """The sound trial with every message of a topic changed, or dropped where None comes back."""
    changed = [edit(row) if row[0] == topic else row for row in rows()]
    return [row for row in changed if row is not None]


def with_message(row: Row, **changes: Any) -> Row:
    return (*row[:3], row[3] | changes)


def refusal(path: Path, trial: list[Row], **options: Any) -> str:
    write_raw(path / "trial.mcap", trial, **RIG)
    with pytest.raises(RecordingError) as caught:
        list(synchronise(Recording(path / "trial.mcap", **options)))
    text = str(caught.value)
    assert text.startswith(f"{path / 'trial.mcap'}: ")
    assert "\n" not in text
    return text


def test_the_sound_trial_is_accepted(tmp_path: Path) -> None:
    recording = Recording(write_raw(tmp_path / "trial.mcap", rows(), **RIG))
    assert len(list(synchronise(recording))) == 25
    assert recording.notes == []


# --- files ---------------------------------------------------------------------------------------------------


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        Recording(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="is a folder"):
        Recording(tmp_path)
    for content in (b"", b"SQLite format 3\0", b"\x89MCAP1\r\n"):
        (tmp_path / "x.mcap").write_bytes(content)
        with pytest.raises(RecordingError, match="is not an MCAP file"):
            Recording(tmp_path / "x.mcap")


def test_a_folder_without_metadata(tmp_path: Path) -> None:
    from tiptrace.streams.bag_source import BagSource

    with pytest.raises(RecordingError, match=r"no metadata.yaml: run 'ros2 bag reindex'"):
        BagSource(tmp_path)


def test_no_rig_attached(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "trial.mcap", rows())
    with pytest.raises(RecordingError, match=r"no rig.yaml attached; give one with --rig"):
        Recording(path)
    assert len(list(synchronise(Recording(path, rig=make_rig())))) == 25


def test_a_rig_with_an_unknown_key_names_the_file_and_the_valid_ones(tmp_path: Path) -> None:
    bad = RIG["rig__yaml"] + b"gripr: {}\n"
    path = write_raw(tmp_path / "trial.mcap", rows(), rig__yaml=bad)
    with pytest.raises(
        TipTraceError, match=r"trial.mcap: rig.yaml: unknown key 'gripr'; valid keys here: format, fr"
    ):
        Recording(path)


def test_references_that_are_no_images_or_of_another_size(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "trial.mcap", rows(), reference_left__png=b"no png", **RIG)
    with pytest.raises(RecordingError, match=r"reference_left.png: is not an image"):
        Recording(path)
    stream = ListStream(trial_samples(0.5), references={"left": texture(0, (32, 24))})
    write_recording(tmp_path / "small.mcap", stream)
    with pytest.raises(RecordingError, match=r"reference is 32x24 px, the left images are 64x48"):
        Recording(tmp_path / "small.mcap")


# --- topics --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topic", [*IMAGE_TOPIC.values(), POSE_TOPIC])
def test_a_missing_topic(tmp_path: Path, topic: str) -> None:
    text = refusal(tmp_path, edited(topic, lambda row: None))
    assert f"no messages on {topic}; topics there:" in text
    assert "tiptrace inspect" in text


def test_no_images_at_all(tmp_path: Path) -> None:
    text = refusal(tmp_path, [row for row in rows() if row[0] not in IMAGE_TOPIC.values()])
    assert "no messages on /tactile/left/image/compressed and /tactile/right/image/compressed" in text


def test_a_topic_of_another_type(tmp_path: Path) -> None:
    text = refusal(
        tmp_path,
        edited(PHASE_TOPIC, lambda row: (PHASE_TOPIC, "std_msgs/msg/Float64", row[2], {"data": 1.0})),
    )
    assert "/trial/phase: type is std_msgs/msg/Float64, expected std_msgs/msg/String" in text


def test_images_of_the_wrong_size(tmp_path: Path) -> None:
    def grow(row: Row) -> Row:
        big = messages.compressed_message(texture(1, (320, 240)), row[2], FRAME_ID["right"], "jpeg", 95)
        return with_message(row, data=big["data"])

    text = refusal(tmp_path, edited(IMAGE_TOPIC["right"], grow))
    assert f"{IMAGE_TOPIC['right']}: images are 320x240 px, the rig file says {SIZE[0]}x{SIZE[1]}" in text
    late = [grow(row) if row[0] == IMAGE_TOPIC["right"] and row[2] > T0 + NS // 2 else row for row in rows()]
    assert "images are 320x240 px" in refusal(tmp_path, late)


def test_images_of_which_none_can_be_decoded(tmp_path: Path) -> None:
    both = [with_message(row, data=b"\xff\xd8") if row[0] in IMAGE_TOPIC.values() else row for row in rows()]
    assert "images that cannot be decoded, left out: 25" in refusal(tmp_path, both)


# --- clocks --------------------------------------------------------------------------------------------------


def restamped(row: Row, stamp_ns: int) -> Row:
    header = messages.header_message(stamp_ns, row[3]["header"]["frame_id"])
    return with_message(row, header=header)


def test_clocks_that_disagree_are_refused_unless_told_which_to_use(tmp_path: Path) -> None:
    """Camera and robot 5 s behind the recorder."""
    late = [restamped(r, r[2] - 5 * NS) if "header" in r[3] else r for r in rows()]
    text = refusal(tmp_path, late)
    assert "header stamps differ from the recorder's clock by -5.0 s" in text
    assert "--stamps header or --stamps log" in text
    by_header = list(synchronise(Recording(tmp_path / "trial.mcap", stamps="header")))
    by_log = list(synchronise(Recording(tmp_path / "trial.mcap", stamps="log")))
    sound = list(synchronise(Recording(write_raw(tmp_path / "sound.mcap", rows(), **RIG))))
    assert (
        [o.stamp_ns + 5 * NS for o in by_header]
        == [o.stamp_ns for o in by_log]
        == [o.stamp_ns for o in sound]
    )
    assert [o.phase for o in by_header] == [o.phase for o in by_log] == [o.phase for o in sound]


def test_clocks_within_a_second_need_no_choice(tmp_path: Path) -> None:
    near = [restamped(r, r[2] - NS // 10) if "header" in r[3] else r for r in rows()]
    path = write_raw(tmp_path / "trial.mcap", near, **RIG)
    assert len(list(synchronise(Recording(path)))) == 25


def test_headers_that_nobody_set(tmp_path: Path) -> None:
    text = refusal(tmp_path, edited(POSE_TOPIC, lambda row: restamped(row, 0)))
    assert "/ee_pose: header stamps are not set" in text
    assert "--stamps log" in text
    assert len(list(synchronise(Recording(tmp_path / "trial.mcap", stamps="log")))) == 25


def test_images_and_poses_without_common_time(tmp_path: Path) -> None:
    moved = [
        (*row[:2], row[2] + 60 * NS, restamped(row, row[2] + 60 * NS)[3]) if row[0] == POSE_TOPIC else row
        for row in rows()
    ]
    text = refusal(tmp_path, moved)
    assert "/tactile/left/image/compressed and /ee_pose have no time in common" in text
    assert "synchronise the clocks" in text


def test_a_clock_set_back_during_the_recording(tmp_path: Path) -> None:
    back = edited(POSE_TOPIC, lambda row: restamped(row, row[2] - (3 * NS if row[2] > T0 + NS // 2 else 0)))
    text = refusal(tmp_path, back, stamps="header")
    assert "stamps jump back by 3.0 s" in text


def test_repeated_and_unordered_stamps_are_sorted_and_noted(tmp_path: Path) -> None:
    def shake(row: Row) -> Row:
        k = (row[2] - T0) // (NS // 100)
        return restamped(row, row[2] + (30_000_000 if k % 10 == 5 else 0))

    path = write_raw(tmp_path / "trial.mcap", edited(POSE_TOPIC, shake), **RIG)
    recording = Recording(path)
    assert len(list(synchronise(recording))) == 25
    assert any("repeated stamps" in note for note in recording.notes)
    assert any("out of order by up to 0.020 s" in note for note in recording.notes)


# --- values --------------------------------------------------------------------------------------------------


def test_positions_in_millimetres(tmp_path: Path) -> None:
    T_mm = hand_pose(T0)
    T_mm[:3, 3] *= 1e3
    text = refusal(tmp_path, edited(POSE_TOPIC, lambda row: pose_row(0, T_mm)))
    assert "/ee_pose: at " in text
    assert "looks like millimetres; publish metres" in text


def test_truth_and_markers_and_opening_in_millimetres(tmp_path: Path) -> None:
    point = {"header": messages.header_message(T0, "base"), "point": {"x": 400.0, "y": 0.0, "z": 10.0}}
    text = refusal(tmp_path, [*rows(), (TRUTH_TOPIC, "geometry_msgs/msg/PointStamped", T0, point)])
    assert "/ground_truth/tip" in text
    assert "millimetres" in text
    cloud = messages.marker_message(np.full((5, 3), 4.0), T0, FRAME_ID["left"])
    text = refusal(tmp_path, [*rows(), (MARKER_TOPIC["left"], "sensor_msgs/msg/PointCloud2", T0, cloud)])
    assert "marker positions are beyond 0.1 m" in text
    text = refusal(tmp_path, [*rows(), (OPENING_TOPIC, "std_msgs/msg/Float64", T0, {"data": 6.2})])
    assert "/gripper/opening" in text
    assert "publish metres" in text


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.6), (float("nan"), 0, 0, 1)])
def test_quaternions_that_are_none(tmp_path: Path, quaternion: tuple[float, ...]) -> None:
    def spoil(row: Row) -> Row:
        orientation = dict(zip("xyzw", map(float, quaternion), strict=True))
        return with_message(row, pose=row[3]["pose"] | {"orientation": orientation})

    text = refusal(tmp_path, edited(POSE_TOPIC, spoil))
    assert "is not a unit quaternion" in text
    assert "expected x, y, z, w" in text


def test_positions_that_are_not_numbers(tmp_path: Path) -> None:
    T = hand_pose(T0)
    T[0, 3] = np.nan
    assert "not finite" in refusal(tmp_path, edited(POSE_TOPIC, lambda row: pose_row(0, T)))


def pivoting(k: int) -> FloatArray:
    """The hand turns by ±5° on two axes about a tip at rest, 0.2 m away."""
    w = np.radians(5) * np.array([np.sin(k / 12), np.sin(k / 7), 0.0])
    R = rotation_exp(w) @ rotation_exp([np.pi, 0.0, 0.0]) @ rotation_exp([0.0, 0.3, 0.0])
    return transform(R, np.array([0.4, 0.1, 0.02]) - R @ np.array([0.0, 0.0, 0.2]))


def test_wxyz_for_xyzw_shows_in_the_anchoring_motion(tmp_path: Path) -> None:
    def turn(row: Row) -> Row:
        k = (row[2] - T0) // (NS // 100)
        return pose_row(k, pivoting(k))

    def exchange(row: Row) -> Row:
        q = turn(row)[3]["pose"]["orientation"]
        wxyz = {"x": q["w"], "y": q["x"], "z": q["y"], "w": q["z"]}
        return with_message(turn(row), pose=turn(row)[3]["pose"] | {"orientation": wxyz})

    path = write_raw(tmp_path / "sound.mcap", edited(POSE_TOPIC, turn), **RIG)
    assert len(list(synchronise(Recording(path)))) == 25
    text = refusal(tmp_path, edited(POSE_TOPIC, exchange))
    assert "/ee_pose: quaternions look like w, x, y, z" in text


@pytest.mark.parametrize("seed", range(5))
def test_sound_anchoring_with_extra_translation_is_not_taken_for_wxyz(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    phase, turn = rng.uniform(0, 6, 2), rotation_exp(rng.normal(0, 1, 3))

    def move(row: Row) -> Row:
        k = (row[2] - T0) // (NS // 100)
        T = transform(turn, [0.3, 0.0, 0.0]) @ pivoting(k)
        T[:2, 3] += 0.004 * np.sin(k / 9 + phase)
        return pose_row(k, T)

    path = write_raw(tmp_path / "trial.mcap", edited(POSE_TOPIC, move), **RIG)
    assert len(list(synchronise(Recording(path)))) == 25


def test_a_frame_that_the_rig_contradicts(tmp_path: Path) -> None:
    def elsewhere(row: Row) -> Row:
        return with_message(row, header=messages.header_message(row[2], "world"))

    text = refusal(tmp_path, edited(POSE_TOPIC, elsewhere))
    assert "/ee_pose: frame_id is 'world', but frames.base of the rig file is 'base'" in text


def test_left_and_right_exchanged(tmp_path: Path) -> None:
    text = refusal(
        tmp_path,
        edited(
            IMAGE_TOPIC["left"],
            lambda row: with_message(row, header=messages.header_message(row[2], FRAME_ID["right"])),
        ),
    )
    assert "left and right are exchanged" in text


# --- phases --------------------------------------------------------------------------------------------------


def marked(*names: str) -> list[Row]:
    marks = [
        (PHASE_TOPIC, "std_msgs/msg/String", T0 + k * NS // 10, {"data": name})
        for k, name in enumerate(names)
    ]
    return sorted([*(row for row in rows() if row[0] != PHASE_TOPIC), *marks], key=lambda row: row[2])


@pytest.mark.parametrize(
    ("names", "match"),
    [
        (("reconstruction", "anchoring"), "first phase is 'reconstruction', not 'anchoring'"),
        (("end", "anchoring"), "phases go on after 'end'"),
        (("anchoring", "end", "reconstruction"), "phases go on after 'end'"),
        (
            ("anchoring", "reconstuction"),
            "unknown phase 'reconstuction'; valid: anchoring, reconstruction, end",
        ),
    ],
)
def test_phases_in_a_wrong_order_or_unknown(tmp_path: Path, names: tuple[str, ...], match: str) -> None:
    text = refusal(tmp_path, marked(*names))
    assert "/trial/phase" in text
    assert match in text


@pytest.mark.parametrize(
    "names",
    [
        (),
        ("anchoring", "anchoring", "reconstruction", "end", "end"),
        ("anchoring", "reconstruction", "anchoring", "reconstruction", "end"),
        ("reconstruction", "end"),
    ],
)
def test_phases_absent_repeated_or_anchored_twice_are_accepted(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    path = write_raw(tmp_path / "trial.mcap", marked(*names), **RIG)
    found = list(synchronise(Recording(path)))
    assert len(found) == 25
    assert all((o.phase is None) == (not names) for o in found)


# --- damage --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Half a second, in several chunks as a longer file has."""
    path = tmp_path_factory.mktemp("sound") / "trial.mcap"
    start = [row for row in rows() if row[2] < T0 + NS // 2]
    return write_raw(path, start, trial__yaml=b"seed: 0", **RIG).read_bytes()


def outcome(path: Path) -> tuple[str, list[int], list[FloatArray]]:
    """What comes of a file: 'refused', or the pairs' stamps and poses."""
    try:
        found = list(synchronise(Recording(path)))
    except TipTraceError:
        return "refused", [], []
    return "used", [o.stamp_ns for o in found], [o.left.T_B_E for o in found]


@pytest.mark.parametrize("seed", range(5))
def test_mutations_are_refused_or_give_a_part_of_the_truth(
    tmp_path: Path, sound_bytes: bytes, seed: int
) -> None:
    """5 × 50 byte flips, overwritten runs, deletions and truncations: no crash, no hang, no wrong pose."""
    path = tmp_path / "trial.mcap"
    path.write_bytes(sound_bytes)
    _, stamps, poses = outcome(path)
    truth = dict(zip(stamps, poses, strict=True))
    rng = np.random.default_rng(seed)
    seen = set()
    for _ in range(50):
        path.write_bytes(mutate(sound_bytes, rng))
        what, got, got_poses = outcome(path)
        seen.add(what)
        assert set(got) <= set(stamps)
        for stamp, T in zip(got, got_poses, strict=True):
            np.testing.assert_array_equal(T, truth[stamp])
    assert seen == {"refused", "used"}


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    broken = bytearray(data)
    at = int(rng.integers(8, len(data)))
    kind = int(rng.integers(4))
    if kind == 0:
        for k in rng.integers(8, len(data), int(rng.integers(1, 4))):
            broken[k] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        return data[:at]
    elif kind == 2:
        run = bytes(rng.integers(0, 256, int(rng.integers(1, 40)), dtype=np.uint8))
        broken[at : at + len(run)] = run
    else:
        del broken[at : at + int(rng.integers(1, 400))]
    return bytes(broken)


def test_bytes_without_a_checksum_may_be_wrong(tmp_path: Path, sound_bytes: bytes) -> None:
    """The bytes that no checksum covers: among the first 200, which hold header and record lengths."""
    path = tmp_path / "trial.mcap"
    for at in range(0, 200, 3):
        broken = bytearray(sound_bytes)
        broken[at] ^= 0xFF
        path.write_bytes(broken)
        outcome(path)


def test_samples_of_a_damaged_file_are_a_subset(tmp_path: Path, sound_bytes: bytes) -> None:
    path = tmp_path / "trial.mcap"
    path.write_bytes(sound_bytes)
    whole = {(type(s), s.stamp_ns) for s in Recording(path)}
    path.write_bytes(sound_bytes[: len(sound_bytes) // 3])
    part = [(type(s), s.stamp_ns) for s in Recording(path)]
    assert set(part) < whole
    assert {kind for kind, _ in part} >= {ImageSample, PoseSample}
