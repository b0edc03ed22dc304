from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from tiptrace.config import dump_yaml
from tiptrace.errors import ConfigError, RecordingError
from tiptrace.geometry.transforms import invert, rotation_exp, transform
from tiptrace.streams.foreign import ForeignRecording
from tiptrace.streams.mapping import MapFile, parse_frame_range
from tiptrace.streams.sources import open_recording
from tiptrace.streams.synchronise import synchronise
from tiptrace.types import ImageSample, Observation, Phase, PoseSample

from .bags import STORE, TYPES, bag, pose_stamped, raw_image, tf_message
from .helpers import NS, PERIOD_NS, SIZE, T0, hand_pose, make_rig, texture

PLUGINS = pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
IMAGES = {"left": {"topic": "/cam_l/image_raw"}, "right": {"topic": "/cam_r/image_raw"}}
TOPICS = MapFile.model_validate(
    IMAGES | {"pose": "/tcp_pose", "phase": "/phase", "opening": "/gap", "truth": "/tip"}
)
TF = MapFile.model_validate(IMAGES | {"tf": {"base": "base_link", "end_effector": "tool0"}})
FRAMES = 25


def write_bag(folder: Path, plugin: StoragePlugin, encoding: str = "rgb8", seconds: float = 1.0) -> Path:
    with bag(folder, plugin) as b:
        b.add("/phase", TYPES["std_msgs/msg/String"](data="anchoring"), T0 - NS // 50)
        for k in range(-5, round(seconds * 100) + 5):
            stamp = T0 + k * NS // 100
            b.add("/tcp_pose", pose_stamped(hand_pose(stamp), stamp), stamp)
            if k % 4 == 0 and 0 <= k < 4 * FRAMES:
                b.add("/cam_l/image_raw", raw_image(texture(k), stamp, encoding, padding=5), stamp)
                b.add(
                    "/cam_r/image_raw",
                    raw_image(texture(k + 1), stamp + 2_000_000, encoding),
                    stamp + 2_000_000,
                )
                b.add("/gap", TYPES["std_msgs/msg/Float64"](data=0.006), stamp)
    return folder


def check(found: list[Observation], encoding: str = "rgb8") -> None:
    assert len(found) == FRAMES
    for k, o in enumerate(found):
        assert o.left.sample.stamp_ns == T0 + k * PERIOD_NS
        for finger, seed in ((o.left, 4 * k), (o.right, 4 * k + 1)):
            np.testing.assert_allclose(finger.T_B_E, hand_pose(finger.sample.stamp_ns), atol=1e-9)
            assert isinstance(finger.sample, ImageSample)
            expected = texture(seed)
            if encoding == "mono8":
                expected = np.repeat(expected[..., :1], 3, axis=2)
            np.testing.assert_array_equal(finger.sample.image, expected)


@PLUGINS
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_bags_with_raw_images_and_poses(tmp_path: Path, plugin: StoragePlugin, encoding: str) -> None:
    path = write_bag(tmp_path / "bag", plugin, encoding)
    found = list(synchronise(ForeignRecording(path, TOPICS, make_rig())))
    check(found, encoding)
    assert {o.phase for o in found} == {Phase.ANCHORING}
    assert {o.opening_m for o in found} == {0.006}


@PLUGINS
def test_a_single_file_out_of_a_bag(tmp_path: Path, plugin: StoragePlugin) -> None:
    folder = write_bag(tmp_path / "bag", plugin)
    (file,) = (p for p in folder.iterdir() if p.suffix in (".mcap", ".db3"))
    check(list(synchronise(ForeignRecording(file, TOPICS, make_rig()))))


def test_a_split_bag(tmp_path: Path) -> None:
    """As ros2 bag record -d writes it: several files, one metadata.yaml."""
    parts = [tmp_path / "part0", tmp_path / "part1"]
    for k, part in enumerate(parts):
        with bag(part) as b:
            for i in range(-5, 106):
                stamp = T0 + i * NS // 100
                if (i >= 50) != bool(k):
                    continue
                b.add("/tcp_pose", pose_stamped(hand_pose(stamp), stamp), stamp)
                if i % 4 == 0 and 0 <= i < 4 * FRAMES:
                    b.add("/cam_l/image_raw", raw_image(texture(i), stamp), stamp)
                    b.add("/cam_r/image_raw", raw_image(texture(i + 1), stamp), stamp)
    whole = tmp_path / "whole"
    whole.mkdir()
    infos = [yaml.safe_load((p / "metadata.yaml").read_text())["rosbag2_bagfile_information"] for p in parts]
    merged = infos[0]
    for k, part in enumerate(parts):
        shutil.copy(part / f"{part.name}.mcap", whole / f"whole_{k}.mcap")
    merged["relative_file_paths"] = ["whole_0.mcap", "whole_1.mcap"]
    merged["message_count"] = sum(i["message_count"] for i in infos)
    merged["duration"]["nanoseconds"] = 1_200_000_000
    for topic in merged["topics_with_message_count"]:
        topic["message_count"] *= 2
    (whole / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": merged}))
    topics = MapFile.model_validate(IMAGES | {"pose": "/tcp_pose"})
    check(list(synchronise(ForeignRecording(whole, topics, make_rig()))))


def test_a_compressed_bag(tmp_path: Path) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    writer = BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for k in range(-5, 106):
            stamp = T0 + k * NS // 100
            rows = [("/tcp_pose", pose_stamped(hand_pose(stamp), stamp))]
            if k % 4 == 0 and 0 <= k < 4 * FRAMES:
                rows += [("/cam_l/image_raw", raw_image(texture(k), stamp))]
                rows += [("/cam_r/image_raw", raw_image(texture(k + 1), stamp))]
            for topic, message in rows:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connections[topic], stamp, STORE.serialize_cdr(message, kind))
    topics = MapFile.model_validate(IMAGES | {"pose": "/tcp_pose"})
    check(list(synchronise(ForeignRecording(tmp_path / "bag", topics, make_rig()))))


# --- TF ------------------------------------------------------------------------------------------------------


T_MOUNT = transform(rotation_exp([0.1, 0.2, 0.3]), [0.0, 0.1, 0.3])
T_FLANGE = transform(rotation_exp([0.0, 0.0, 1.0]), [0.0, 0.0, 0.1])


def write_tf_bag(folder: Path, plugin: StoragePlugin) -> Path:
    """world → base_link static; base_link → arm at 100 Hz; arm → wrist at 40 Hz; wrist → tool0 static."""

    def arm(stamp: int) -> np.ndarray:
        return transform(rotation_exp([0.0, 0.4 * (stamp - T0) / NS, 0.0]), [0.1, 0.0, 0.2])

    with bag(folder, plugin) as b:
        static = [("world", "base_link", T_MOUNT), ("wrist", "tool0", T_FLANGE)]
        b.add("/tf_static", tf_message(static, T0 - NS), T0 - NS // 2)
        for k in range(-5, 106):
            stamp = T0 + k * NS // 100
            b.add("/tf", tf_message([("base_link", "arm", arm(stamp))], stamp), stamp)
            if k % 2 == 0:
                T_wrist = invert(arm(stamp)) @ hand_pose(stamp) @ invert(T_FLANGE)
                b.add("/tf", tf_message([("arm", "wrist", T_wrist)], stamp), stamp)
            if k % 4 == 0 and 0 <= k < 4 * FRAMES:
                b.add("/cam_l/image_raw", raw_image(texture(k), stamp), stamp)
                b.add("/cam_r/image_raw", raw_image(texture(k + 1), stamp), stamp)
    return folder


@PLUGINS
def test_poses_from_a_tf_chain(tmp_path: Path, plugin: StoragePlugin) -> None:
    path = write_tf_bag(tmp_path / "bag", plugin)
    recording = ForeignRecording(path, TF, make_rig(frames={"base": "base_link"}))
    assert len([s for s in recording if isinstance(s, PoseSample)]) >= 105
    found = list(synchronise(recording))
    assert len(found) == FRAMES
    for o in found:
        np.testing.assert_allclose(o.left.T_B_E, hand_pose(o.left.sample.stamp_ns), atol=1e-9)


def test_a_chain_through_a_common_parent(tmp_path: Path) -> None:
    path = write_tf_bag(tmp_path / "bag", StoragePlugin.MCAP)
    chain = MapFile.model_validate(IMAGES | {"tf": {"base": "world", "end_effector": "tool0"}})
    o = next(iter(synchronise(ForeignRecording(path, chain, make_rig()))))
    np.testing.assert_allclose(o.left.T_B_E, T_MOUNT @ hand_pose(o.left.sample.stamp_ns), atol=1e-9)
    chain = MapFile.model_validate(IMAGES | {"tf": {"base": "tool0", "end_effector": "base_link"}})
    o = next(iter(synchronise(ForeignRecording(path, chain, make_rig()))))
    np.testing.assert_allclose(o.left.T_B_E, invert(hand_pose(o.left.sample.stamp_ns)), atol=1e-9)


@pytest.mark.parametrize(
    ("base", "end_effector", "match"),
    [
        ("base_link", "gripper", "no frame 'gripper'; frames there: arm, base_link, tool0, world, wrist"),
        ("world", "base_link", "nothing moves"),
    ],
)
def test_chains_that_give_no_pose_are_refused(
    tmp_path: Path, base: str, end_effector: str, match: str
) -> None:
    path = write_tf_bag(tmp_path / "bag", StoragePlugin.MCAP)
    chain = MapFile.model_validate(IMAGES | {"tf": {"base": base, "end_effector": end_effector}})
    with pytest.raises(RecordingError, match=match):
        ForeignRecording(path, chain, make_rig())


def test_a_chain_that_the_rig_file_contradicts_is_refused(tmp_path: Path) -> None:
    path = write_tf_bag(tmp_path / "bag", StoragePlugin.MCAP)
    with pytest.raises(RecordingError, match=r"frames\.base of the rig file is 'world'"):
        ForeignRecording(path, TF, make_rig(frames={"base": "world"}))


# --- crop, references, map files -----------------------------------------------------------------------------


def test_images_are_cropped_flipped_and_resized(tmp_path: Path) -> None:
    big = texture(7, (200, 160))
    with bag(tmp_path / "bag") as b:
        for k in range(5):
            stamp = T0 + k * PERIOD_NS
            b.add("/tcp_pose", pose_stamped(hand_pose(stamp), stamp), stamp)
            b.add("/cam_l/image_raw", raw_image(big, stamp), stamp)
            b.add("/cam_r/image_raw", raw_image(big, stamp), stamp)
    view = {"crop_px": [20, 10, 128, 96], "flip": "horizontal", "resize_px": list(SIZE)}
    topics = MapFile.model_validate(
        {"left": IMAGES["left"] | view, "right": IMAGES["right"] | view, "pose": "/tcp_pose"}
    )
    recording = ForeignRecording(
        tmp_path / "bag", topics, make_rig(), references={"left": big, "right": big}, stamps="header"
    )
    expected = cv2.resize(big[10:106, 20:148][:, ::-1], SIZE, interpolation=cv2.INTER_AREA)
    sample = next(s for s in recording if isinstance(s, ImageSample))
    np.testing.assert_array_equal(sample.image, expected)
    np.testing.assert_array_equal(recording.references["left"], expected)
    outside = MapFile.model_validate(
        {
            "left": IMAGES["left"] | {"crop_px": [150, 0, 100, 100]},
            "right": IMAGES["right"],
            "pose": "/tcp_pose",
        }
    )
    with pytest.raises(ConfigError, match="lies outside the image of 200x160 px"):
        ForeignRecording(tmp_path / "bag", outside, make_rig())


def test_reference_frames_are_averaged(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", StoragePlugin.MCAP)
    recording = ForeignRecording(path, TOPICS, make_rig(), reference_frames=(2, 6))
    expected = np.mean([texture(4 * k).astype(float) for k in range(2, 6)], axis=0)
    np.testing.assert_allclose(recording.references["left"], expected, atol=0.51)
    with pytest.raises(RecordingError, match="25 images"):
        ForeignRecording(path, TOPICS, make_rig(), reference_frames=(0, 26))


@pytest.mark.parametrize("text", ["20", "5:5", "9:3", "-1:3", "a:b", ""])
def test_frame_ranges_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="START:STOP"):
        parse_frame_range(text)


def test_open_recording_reads_files_as_the_command_line_gives_them(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    (tmp_path / "map.yaml").write_text(dump_yaml(TOPICS))
    (tmp_path / "rig.yaml").write_text(dump_yaml(make_rig()))
    cv2.imwrite(str(tmp_path / "left.png"), texture(1))
    recording = open_recording(
        path,
        map_file=tmp_path / "map.yaml",
        rig=tmp_path / "rig.yaml",
        reference_left=tmp_path / "left.png",
        reference_frames="0:20",
    )
    check(list(synchronise(recording)))
    np.testing.assert_array_equal(recording.references["left"], texture(1))
    assert set(recording.references) == {"left", "right"}
    with pytest.raises(RecordingError, match="is not in tiptrace's format"):
        open_recording(path)
    with pytest.raises(ConfigError, match="needs a rig file"):
        open_recording(path, map_file=tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_text(json.dumps({"left": {"topic": "/a"}, "right": {"topik": "/b"}}))
    with pytest.raises(
        ConfigError, match=r"unknown key 'right.topik'; valid keys here: topic, crop_px, flip"
    ):
        open_recording(path, map_file=tmp_path / "map.yaml", rig=tmp_path / "rig.yaml")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"pose": None}, "either pose"),
        ({"tf": {"base": "a", "end_effector": "b"}}, "either pose"),
        ({"right": IMAGES["left"]}, "same topic"),
    ],
)
def test_maps_that_cannot_be_meant_are_refused(change: dict[str, object], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        MapFile.model_validate(IMAGES | {"pose": "/tcp_pose"} | change)


def test_a_missing_topic_names_what_is_there(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    topics = MapFile.model_validate(IMAGES | {"pose": "/ee"})
    with pytest.raises(
        RecordingError, match=r"no messages on /ee; topics there: /cam_l/image_raw, .*inspect"
    ):
        ForeignRecording(path, topics, make_rig())


@PLUGINS
def test_damaged_bags_are_refused_or_used_as_far_as_they_go(tmp_path: Path, plugin: StoragePlugin) -> None:
    folder = write_bag(tmp_path / "bag", plugin)
    (file,) = (p for p in folder.iterdir() if p.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    rng = np.random.default_rng(0)
    refusals = []
    for _ in range(30):
        broken = bytearray(data[: int(rng.uniform(0.1, 1.0) * len(data))])
        for at in rng.integers(0, len(broken), 3):
            broken[at] = int(rng.integers(256))
        file.write_bytes(broken)
        try:
            found = list(synchronise(ForeignRecording(folder, TOPICS, make_rig())))
        except (RecordingError, ConfigError) as error:
            refusals.append(str(error))
        else:
            assert len(found) <= FRAMES
    assert all(str(tmp_path) in refusal for refusal in refusals)
