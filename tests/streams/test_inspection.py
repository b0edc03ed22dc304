from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
import yaml
from rosbags.rosbag2 import StoragePlugin
from typer.testing import CliRunner

from tiptrace.cli.inspect import inspect
from tiptrace.config import load_yaml
from tiptrace.errors import ConfigError, RecordingError
from tiptrace.streams.foreign import ForeignRecording
from tiptrace.streams.inspection import inspect_recording
from tiptrace.streams.mapping import MapFile
from tiptrace.streams.synchronise import synchronise
from tiptrace.streams.topics import IMAGE_TOPIC, POSE_TOPIC
from tiptrace.streams.writer import write_recording
from tiptrace.types import SIDES, PoseSample, TruthSample

from .bags import TYPES, bag, pose_stamped, raw_image
from .helpers import NS, PERIOD_NS, T0, ListStream, hand_pose, make_rig, texture, trial_samples
from .test_foreign import write_bag, write_tf_bag

app = typer.Typer()
app.command()(inspect)


@pytest.fixture(scope="module")
def trial_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("inspect") / "trial.mcap"
    references = {side: texture(k) for k, side in enumerate(SIDES)}
    write_recording(path, ListStream(trial_samples(2.0), references=references))
    return path


def test_a_recording_in_tiptrace_format_is_usable(trial_path: Path) -> None:
    found = inspect_recording(trial_path)
    assert found.own_format
    assert found.usable
    assert found.problems == ()
    assert found.proposed_map is None
    roles = {topic.topic: topic.role for topic in found.topics}
    assert roles[IMAGE_TOPIC["left"]] == "left image"
    assert roles[POSE_TOPIC] == "pose"
    pose = next(t for t in found.topics if t.topic == POSE_TOPIC)
    assert pose.count == 203
    assert pose.rate_hz == pytest.approx(100)
    assert pose.longest_gap_s == pytest.approx(0.01)
    assert pose.clock_difference_s == 0
    assert "reference_left.png" in found.attachments
    assert "no tool.yaml" in " ".join(found.notes)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    samples = [s for s in trial_samples(1.0) if not isinstance(s, PoseSample | TruthSample)]
    write_recording(tmp_path / "trial.mcap", ListStream(samples))
    found = inspect_recording(tmp_path / "trial.mcap")
    assert not found.usable
    assert "no messages on /ee_pose" in found.problems[0]


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_the_proposed_map_reads_the_bag(tmp_path: Path, plugin: StoragePlugin) -> None:
    path = write_bag(tmp_path / "bag", plugin)
    result = CliRunner().invoke(app, [str(path), "--write-map", str(tmp_path / "map.yaml")])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "map.yaml").read_text()
    assert "resize_px" in text  # the test images are smaller than the processing size
    assert yaml.safe_load(text)["pose"] == "/tcp_pose"
    proposal = load_yaml(MapFile, tmp_path / "map.yaml")
    rig = make_rig().model_dump()
    for side in SIDES:
        rig["sensors"][side]["image_size_px"] = (320, 240)
    recording = ForeignRecording(path, proposal, make_rig(**rig))
    assert len(list(synchronise(recording))) == 25
    with pytest.raises(ConfigError, match="exists already"):
        inspect(path, write_map=tmp_path / "map.yaml")


def test_a_tf_chain_is_proposed_where_no_pose_topic_is(tmp_path: Path) -> None:
    found = inspect_recording(write_tf_bag(tmp_path / "bag", StoragePlugin.MCAP))
    assert found.usable
    assert found.proposed_map is not None
    assert found.proposed_map.tf is not None
    assert (found.proposed_map.tf.base, found.proposed_map.tf.end_effector) == ("base_link", "tool0")


def test_what_a_bag_needs_besides_a_map_is_noted(tmp_path: Path) -> None:
    with bag(tmp_path / "bag") as b:
        for k in range(5):
            stamp = T0 + k * PERIOD_NS
            T_mm = hand_pose(stamp)
            T_mm[:3, 3] *= 1e3
            b.add("/tcp_pose", pose_stamped(T_mm, stamp, "base_link"), stamp + 10 * NS)
            for side in SIDES:
                b.add(f"/{side}/image_raw", raw_image(texture(k), stamp), stamp)
    found = inspect_recording(tmp_path / "bag")
    text = " ".join(found.notes)
    assert "/tcp_pose: header and recorder's clock differ by -10.0 s: choose with --stamps" in text
    assert "looks like millimetres" in text
    assert "frame_id is 'base_link': the rig file must say so in frames.base" in text


def test_a_bag_without_tactile_images_or_poses_has_no_map(tmp_path: Path) -> None:
    with bag(tmp_path / "bag") as b:
        b.add("/camera/image_raw", raw_image(texture(0), T0), T0)
        b.add("/odometer", TYPES["std_msgs/msg/Float64"](data=1.0), T0)
    found = inspect_recording(tmp_path / "bag")
    assert not found.usable
    assert found.proposed_map is None
    assert len(found.problems) == 3
    assert "image topics: /camera/image_raw" in found.problems[0]
    assert "no end-effector pose" in found.problems[2]
    with pytest.raises(ConfigError, match="no map can be proposed"):
        inspect(tmp_path / "bag", write_map=tmp_path / "map.yaml")


def test_the_table_and_the_json_say_the_same(trial_path: Path, tmp_path: Path) -> None:
    table = CliRunner().invoke(app, [str(trial_path)], env={"COLUMNS": "200"})
    assert table.exit_code == 0
    assert "usable" in table.output
    assert "100.0" in table.output
    data = json.loads(CliRunner().invoke(app, [str(trial_path), "--json"]).output)
    assert data["usable"] is True
    assert {t["topic"] for t in data["topics"]} == {t.topic for t in inspect_recording(trial_path).topics}
    foreign = json.loads(
        CliRunner().invoke(app, [str(write_bag(tmp_path / "bag", StoragePlugin.MCAP)), "--json"]).output
    )
    assert MapFile.model_validate(foreign["proposed_map"]).pose == "/tcp_pose"


def test_a_cut_recording_is_usable_and_says_so(trial_path: Path, tmp_path: Path) -> None:
    data = trial_path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: 2 * len(data) // 3])
    found = inspect_recording(tmp_path / "cut.mcap")
    assert found.usable
    assert "cut off" in found.notes[0]


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RecordingError, match="is not a recording"):
        inspect_recording(tmp_path / "notes.txt")
    with pytest.raises(RecordingError, match="cannot be read"):
        inspect_recording(tmp_path / "nothing")
    with pytest.raises(RecordingError, match=r"no metadata.yaml"):
        inspect_recording(tmp_path)
