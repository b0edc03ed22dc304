from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from tiptrace.config import Tool
from tiptrace.errors import RecordingError
from tiptrace.streams.recording import Recording
from tiptrace.streams.synchronise import synchronise
from tiptrace.streams.writer import RecordingWriter, write_recording
from tiptrace.types import (
    ImageSample,
    MarkerSample,
    OpeningSample,
    PhaseSample,
    PoseSample,
    Sample,
    TruthSample,
)

from .helpers import NS, SIZE, T0, ListStream, hand_pose, make_rig, texture, trial_samples

T = TypeVar("T")
TOOL = Tool(thickness_m=0.0086, tip_E_m=(0.0, 0.0, 0.2), tip_sigma_m=(0.003, 0.003, 0.005))


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    return trial_samples(2.0)


@pytest.fixture(scope="module")
def stream(samples: list[Sample]) -> ListStream:
    references = {"left": texture(900), "right": texture(901)}
    return ListStream(samples, tool=TOOL, references=references, gel_models={"gel_left.onnx": b"\x08\x01"})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def trial_path(stream: ListStream, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "trial.mcap"
    write_recording(path, stream, trial={"trajectory": "T3", "seed": 0})
    return path


def of_kind(samples: list[Sample], kind: type[T]) -> list[T]:
    return [s for s in samples if isinstance(s, kind)]


def test_what_is_written_is_read_back(trial_path: Path, samples: list[Sample], stream: ListStream) -> None:
    recording = Recording(trial_path)
    got = list(recording)
    assert [(type(s), s.stamp_ns) for s in sorted(got, key=lambda s: (s.stamp_ns, type(s).__name__))] == [
        (type(s), s.stamp_ns)
        for s in sorted(samples, key=lambda s: (s.stamp_ns, type(s).__name__))
        if not isinstance(s, TruthSample)
    ]
    for a, b in zip(of_kind(got, PoseSample), of_kind(samples, PoseSample), strict=True):
        np.testing.assert_allclose(a.T_B_E, b.T_B_E, atol=1e-12)
    for a, b in zip(of_kind(got, ImageSample), of_kind(samples, ImageSample), strict=True):
        assert a.side == b.side
        assert np.abs(a.image.astype(int) - b.image).mean() < 3  # jpeg
    assert of_kind(got, OpeningSample) == of_kind(samples, OpeningSample)
    assert of_kind(got, PhaseSample) == of_kind(samples, PhaseSample)
    assert recording.rig == stream.rig
    assert recording.tool == TOOL
    assert recording.trial == {"trajectory": "T3", "seed": 0}
    assert recording.gel_models == stream.gel_models
    assert recording.notes == []
    for side in ("left", "right"):
        np.testing.assert_array_equal(recording.references[side], stream.references[side])  # type: ignore[index]


def test_the_truth_is_apart_from_the_samples(trial_path: Path, samples: list[Sample]) -> None:
    recording = Recording(trial_path)
    assert not of_kind(list(recording), TruthSample)
    got, expected = recording.truth(), of_kind(samples, TruthSample)
    assert [t.stamp_ns for t in got] == [t.stamp_ns for t in expected]
    np.testing.assert_array_equal([t.p_B for t in got], [t.p_B for t in expected])


def test_observations_from_the_file_equal_those_from_memory(trial_path: Path, stream: ListStream) -> None:
    read, made = list(synchronise(Recording(trial_path))), list(synchronise(stream))
    assert len(read) == len(made) == 50
    for a, b in zip(read, made, strict=True):
        assert (a.stamp_ns, a.phase, a.opening_m) == (b.stamp_ns, b.phase, b.opening_m)
        np.testing.assert_allclose(a.left.T_B_E, b.left.T_B_E, atol=1e-12)
        np.testing.assert_allclose(a.right.T_B_E, b.right.T_B_E, atol=1e-12)
        assert [p.stamp_ns for p in a.poses] == [p.stamp_ns for p in b.poses]


def test_png_is_lossless(tmp_path: Path, samples: list[Sample]) -> None:
    images = [s for s in samples if isinstance(s, ImageSample | PoseSample)][:40]
    write_recording(tmp_path / "trial.mcap", ListStream(images), image_format="png")
    got = of_kind(list(Recording(tmp_path / "trial.mcap")), ImageSample)
    for a, b in zip(got, of_kind(images, ImageSample), strict=True):
        np.testing.assert_array_equal(a.image, b.image)


def test_markers_keep_every_bit_and_their_gaps(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    written: list[Sample] = []
    for k in range(10):
        x_S = rng.normal(0, 0.005, (63, 3))
        x_S[k] = np.nan
        written += [
            MarkerSample("left", T0 + k * NS // 25, x_S),
            MarkerSample("right", T0 + k * NS // 25, -x_S),
        ]
        written.append(PoseSample(T0 + k * NS // 25, hand_pose(T0 + k * NS // 25)))
    write_recording(tmp_path / "trial.mcap", ListStream(written))
    recording = Recording(tmp_path / "trial.mcap")
    for a, b in zip(of_kind(list(recording), MarkerSample), of_kind(written, MarkerSample), strict=True):
        assert (a.side, a.stamp_ns) == (b.side, b.stamp_ns)
        np.testing.assert_array_equal(a.x_S, b.x_S)
    assert len(list(synchronise(recording))) == 10


# --- independent readers ------------------------------------------------------------------------------------


def test_mcap_ros2_support_reads_it(trial_path: Path, samples: list[Sample]) -> None:
    counts: dict[str, int] = {}
    with trial_path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        names = {a.name for a in reader.iter_attachments()}
        for _, channel, message, ros in reader.iter_decoded_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if channel.topic.endswith("compressed"):
                side = channel.topic.split("/")[2]
                assert ros.header.frame_id == f"tactile_{side}"
                assert ros.header.stamp.sec * NS + ros.header.stamp.nanosec == message.log_time
                assert ros.format == "jpeg"
                assert cv2.imdecode(np.frombuffer(ros.data, np.uint8), cv2.IMREAD_COLOR).shape == (
                    *SIZE[::-1],
                    3,
                )
    assert names >= {
        "rig.yaml",
        "tool.yaml",
        "trial.yaml",
        "reference_left.png",
        "reference_right.png",
        "gel_left.onnx",
    }
    assert counts == {
        "/tactile/left/image/compressed": 50,
        "/tactile/right/image/compressed": 50,
        "/ee_pose": len(of_kind(samples, PoseSample)),
        "/gripper/opening": 20,
        "/trial/phase": 3,
        "/ground_truth/tip": 50,
    }


def test_rosbags_reads_it(trial_path: Path, samples: list[Sample]) -> None:
    poses, phases, openings = [], [], []
    with AnyReader([trial_path]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/ee_pose":
                p, q = message.pose.position, message.pose.orientation  # type: ignore[attr-defined]
                poses.append([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
                assert message.header.frame_id == "base"  # type: ignore[attr-defined]
            elif connection.topic == "/trial/phase":
                phases.append(message.data)  # type: ignore[attr-defined]
            elif connection.topic == "/gripper/opening":
                openings.append(message.data)  # type: ignore[attr-defined]
    expected = [s.T_B_E for s in of_kind(samples, PoseSample)]
    np.testing.assert_allclose([p[:3] for p in poses], [T[:3, 3] for T in expected])
    from scipy.spatial.transform import Rotation

    np.testing.assert_allclose(
        Rotation.from_quat([p[3:] for p in poses]).as_matrix(), [T[:3, :3] for T in expected], atol=1e-12
    )
    assert phases == ["anchoring", "reconstruction", "end"]
    assert openings == [s.opening_m for s in of_kind(samples, OpeningSample)]


# --- atomicity, damage --------------------------------------------------------------------------------------


def test_a_writer_that_fails_leaves_no_target_but_a_readable_part(
    tmp_path: Path, samples: list[Sample]
) -> None:
    class Failing(ListStream):
        def __iter__(self) -> Iterator[Sample]:
            yield from samples[:250]
            raise ZeroDivisionError

    path = tmp_path / "trial.mcap"
    with pytest.raises(ZeroDivisionError):
        write_recording(path, Failing([]))
    assert not path.exists()
    part = Recording(tmp_path / "trial.partial.mcap")
    assert [s.stamp_ns for s in part] == [s.stamp_ns for s in samples[:250] if not isinstance(s, TruthSample)]


def test_what_was_synced_can_be_read_before_its_chunk_is_full(tmp_path: Path, samples: list[Sample]) -> None:
    written = [s for s in samples[:100] if not isinstance(s, TruthSample)]
    with RecordingWriter(tmp_path / "trial.mcap", rig=make_rig(), chunk_bytes=2**24) as writer:
        for sample in written[:60]:
            writer.write(sample)
        writer.sync({"a": "note"})
        for sample in written[60:]:
            writer.write(sample)
        part = Recording(writer.partial_path)
        assert [s.stamp_ns for s in part] == [s.stamp_ns for s in written[:60]]
    assert [s.stamp_ns for s in Recording(writer.path)] == [s.stamp_ns for s in written]


def test_the_same_stream_gives_the_same_bytes(tmp_path: Path, stream: ListStream, trial_path: Path) -> None:
    write_recording(tmp_path / "again.mcap", stream, trial={"trajectory": "T3", "seed": 0})
    assert (tmp_path / "again.mcap").read_bytes() == trial_path.read_bytes()


def test_unordered_delivery_is_read_in_log_time_order(tmp_path: Path, samples: list[Sample]) -> None:
    order = np.random.default_rng(1).permutation(len(samples))
    write_recording(tmp_path / "trial.mcap", ListStream([samples[k] for k in order]))
    stamps = [s.stamp_ns for s in Recording(tmp_path / "trial.mcap")]
    assert stamps == sorted(stamps)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, stream: ListStream) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_recording(tmp_path / "file" / "trial.mcap", stream)


def test_a_stamp_that_the_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is negative"):
        write_recording(tmp_path / "trial.mcap", ListStream([PoseSample(-1, np.eye(4))]))


def test_a_full_disk_is_said_in_a_sentence(stream: ListStream) -> None:
    writer = RecordingWriter(Path("trial.mcap"), rig=make_rig())
    writer.path, writer.partial_path = Path("/dev/full"), Path("/dev/full")
    if not writer.partial_path.exists():
        pytest.skip("needs /dev/full")

    def fill() -> None:
        with writer:
            for sample in stream:
                writer.write(sample)

    with pytest.raises(RecordingError, match="No space left"):
        fill()


@pytest.fixture(scope="module")
def long_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "trial.mcap"
    write_recording(path, ListStream(trial_samples(8.0)))
    return path


@pytest.mark.parametrize("fraction", [0.3, 0.5, 0.8])
def test_a_recording_cut_in_the_middle_is_used_as_far_as_it_goes(
    tmp_path: Path, long_path: Path, fraction: float
) -> None:
    data = long_path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(fraction * len(data))])
    recording = Recording(tmp_path / "cut.mcap")
    pairs = list(synchronise(recording))
    assert fraction - 0.25 < len(pairs) / 200 <= fraction
    whole = list(synchronise(Recording(long_path)))
    for a, b in zip(pairs, whole, strict=False):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.left.T_B_E, b.left.T_B_E)
    after_s = (pairs[-1].stamp_ns - pairs[0].stamp_ns) / NS
    (note,) = recording.notes
    assert "cut off, after" in note
    assert "used as far as it goes" in note
    assert abs(float(note.split("after ")[1].split(" s")[0]) - after_s) < 0.2


def test_damage_in_the_middle_ends_the_recording_there(tmp_path: Path, long_path: Path) -> None:
    data = bytearray(long_path.read_bytes())
    with long_path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0x10
    (tmp_path / "bad.mcap").write_bytes(data)
    recording = Recording(tmp_path / "bad.mcap")
    assert 50 < len(list(synchronise(recording))) < 110
    assert "damaged at byte" in recording.notes[0]


def test_a_recording_without_index_is_complete(tmp_path: Path, trial_path: Path) -> None:
    with trial_path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    end = max(i.chunk_start_offset + i.chunk_length + i.message_index_length for i in summary.chunk_indexes)
    (tmp_path / "open.mcap").write_bytes(trial_path.read_bytes()[:end])
    recording = Recording(tmp_path / "open.mcap")
    assert len(list(synchronise(recording))) == 50


def test_one_bad_image_is_left_out_and_noted(tmp_path: Path, samples: list[Sample]) -> None:
    path = tmp_path / "trial.mcap"
    with RecordingWriter(path, rig=make_rig()) as writer:
        original = writer._message

        def damaged(sample: Sample) -> tuple[str, str, dict[str, object]]:
            topic, kind, message = original(sample)
            if isinstance(sample, ImageSample) and sample.stamp_ns == T0 + 10 * NS // 25:
                message["data"] = b"\xff\xd8no jpeg"
            return topic, kind, message

        writer._message = damaged  # type: ignore[method-assign]
        for sample in samples:
            writer.write(sample)
    recording = Recording(path)
    assert len(list(synchronise(recording))) == 49
    assert any(note.startswith("/tactile/left") and "left out: 1 " in note for note in recording.notes)


def test_a_copy_under_another_name_is_the_same_trial(tmp_path: Path, trial_path: Path) -> None:
    shutil.copy(trial_path, tmp_path / "other.bin")
    assert len(list(Recording(tmp_path / "other.bin"))) == len(list(Recording(trial_path)))
