"""record, live, setup and doctor, as a user runs them, against servers on loopback."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.live.servers import FPS, Feed, MjpegServer, feed_from
from tests.live.simulated import short_trial
from tiptrace.cli import app
from tiptrace.cli.live_terminal import keys
from tiptrace.config import Rig, dump_yaml, load_yaml
from tiptrace.drivers.base import Frame
from tiptrace.drivers.no_robot import NoRobot
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import ConfigError, DeviceError, RecordingError, TipTraceError
from tiptrace.live.setup import crop_for, with_gel_models
from tiptrace.live.start import read_rig_folder
from tiptrace.streams.live import LiveStream
from tiptrace.streams.recording import Recording
from tiptrace.streams.writer import RecordingWriter
from tiptrace.types import SIDES, ImageSample, Phase, PoseSample, Side

runner = CliRunner()


@pytest.fixture
def cameras() -> Iterator[list[str]]:
    """A short trial on two cameras; their arguments."""
    feed = feed_from(short_trial()[2], offset_s=0.003)
    start = time.monotonic()
    servers = {side: MjpegServer(side, feed, start) for side in SIDES}
    yield [part for side in SIDES for part in (f"--{side}", servers[side].url)]
    for server in servers.values():
        server.close()


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    rig, references, _ = short_trial()
    path = tmp_path / "rig.yaml"
    path.write_text(dump_yaml(rig))
    for side, image in references.items():
        cv2.imwrite(str(tmp_path / f"reference_{side}.png"), image)
    return path


@pytest.fixture
def poses(tmp_path: Path) -> str:
    """A replay of poses that turn about a point."""
    path = tmp_path / "poses.csv"
    rows = [f"{k * 8_000_000},{0.4 + 1e-5 * k},-0.15,0.2,1,0,0,0" for k in range(4000)]
    path.write_text("stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw\n" + "\n".join(rows) + "\n")
    return f"replay:{path}"


def run(*arguments: str) -> tuple[int, str, BaseException | None]:
    result = runner.invoke(app, list(arguments))
    return result.exit_code, result.output, result.exception


def test_record_writes_what_the_devices_sent(
    cameras: list[str], rig_file: Path, poses: str, tmp_path: Path
) -> None:
    out = tmp_path / "trial.mcap"
    arguments = [
        "record",
        "--rig",
        str(rig_file),
        "--robot",
        poses,
        "--out",
        str(out),
        "--duration",
        "2",
        *cameras,
    ]
    code, output, _ = run(*arguments)
    assert code == 0, output
    assert "left gel:" in output
    recording = Recording(out)
    assert recording.notes == []
    assert len(recording.survey["/ee_pose"].log_ns) > 30
    assert set(recording.references) == set(SIDES)
    code, _, error = run(*arguments)
    assert isinstance(error, RecordingError)
    assert "exists already" in str(error)


def test_an_image_is_logged_when_it_came_however_long_it_then_waits(rig_file: Path) -> None:
    """Else a machine that stands still makes the recording's two clocks differ, and it is refused."""
    timeline = Timeline()
    logged: list[int] = []
    stream = LiveStream(load_yaml(Rig, rig_file), {}, NoRobot(), timeline)
    stream.tap = lambda sample, log_time_ns, jpeg: logged.append(log_time_ns)
    stream.begin()
    stamp = timeline.now_ns()
    time.sleep(0.1)
    stream._tap_frame("left", Frame(stamp, stamp + 1_000_000, np.zeros((2, 2, 3), np.uint8)))
    assert logged == [stamp + 1_000_000]


def test_an_unfinished_recording_of_the_name_is_refused_before_anything_is_opened(
    rig_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "trial.partial.mcap").write_bytes(b"what was saved")
    options = ["--rig", str(rig_file), "--robot", "ur://nowhere"]
    for command in (["record", "--out"], ["live", "--record"]):
        _, output, error = run(*command, str(tmp_path / "trial.mcap"), *options)
        assert isinstance(error, RecordingError)
        assert "trial.partial.mcap: exists already" in str(error)
        assert "recording:" not in output


def test_live_prints_estimates_and_a_summary(cameras: list[str], rig_file: Path, poses: str) -> None:
    code, output, _ = run("live", "--rig", str(rig_file), "--robot", poses, "--duration", "3", *cameras)
    assert code == 0, output
    assert "anchoring" in output
    assert "pairs in" in output


@pytest.mark.parametrize(
    ("changes", "kind", "told"),
    [
        (["--left", "v4l2:NONE"], DeviceError, "is not there"),
        (["--left", "/dev/video0"], ConfigError, "number changes"),
        (["--left", "http://127.0.0.1:9/"], DeviceError, "cannot be reached"),
        (["--left", "SAME", "--right", "SAME"], ConfigError, "same camera"),
        (["--robot", "kuka"], ConfigError, "give ur://HOST"),
        (["--robot", "replay:missing.csv"], DeviceError, "cannot be read"),
        (["--robot", "none"], ConfigError, "tiptrace record"),
        (["--serve", "here:there"], ConfigError, "HOST:PORT"),
    ],
)
def test_what_is_missing_is_named(
    changes: list[str], kind: type[TipTraceError], told: str, cameras: list[str], rig_file: Path, poses: str
) -> None:
    _, _, error = run("live", "--rig", str(rig_file), "--robot", poses, *cameras, *changes)
    assert isinstance(error, kind)
    assert told in str(error)


def test_doctor_measures_and_names_what_fails(cameras: list[str], rig_file: Path, poses: str) -> None:
    code, output, _ = run("doctor", "--rig", str(rig_file), "--robot", poses, "--seconds", "1", *cameras)
    for line in ("disk", "clock", "left reference: there", "jitter"):
        assert line in output
    code, output, _ = run("doctor", "--robot", "replay:missing.csv", "--seconds", "1")
    assert code == 2
    assert "replay" in output or "missing.csv" in output
    assert "→" in output


def test_doctor_tells_what_live_would_refuse(cameras: list[str], rig_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "trial.mcap"
    rig = load_yaml(Rig, rig_file)
    with RecordingWriter(path, rig=rig) as writer:
        for k in range(300):
            writer.write(PoseSample(NS + k * 10_000_000, np.eye(4)))
    other = rig.model_copy(update={"frames": rig.frames.model_copy(update={"base": "base_link"})})
    rig_file.write_text(dump_yaml(other))
    arguments = ["--rig", str(rig_file), "--robot", f"replay:{path}", "--seconds", "0.5", *cameras]
    code, output, _ = run("doctor", *arguments)
    assert code == 2
    assert "fail robot's pose: the robot's pose is given in 'base'" in output
    _, _, error = run("doctor", *cameras)
    assert isinstance(error, ConfigError)
    assert "--rig" in str(error)


def test_live_without_a_reference_is_refused_before_anything_is_opened(rig_file: Path) -> None:
    (rig_file.parent / "reference_right.png").unlink()
    _, _, error = run("live", "--rig", str(rig_file), "--robot", "ur://nowhere")
    assert isinstance(error, ConfigError)
    assert "reference_right.png" in str(error)
    assert "tiptrace setup" in str(error)


# --- keys --------------------------------------------------------------------------------------------------


class Marks:
    """Takes marks."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def advance(self) -> Phase | None:
        self.told.append("mark")
        return None

    def stop(self) -> None:
        self.told.append("stop")


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ([(0.0, b" ")], ["mark"]),
        ([(0.0, b" "), (0.5, b" "), (0.1, b"  "), (0.1, b"   ")], ["mark"]),  # held down
        ([(0.0, b"   "), (1.0, b"q")], ["mark", "stop"]),  # nothing is left over from the first
        ([(0.0, b" "), (1.0, b" ")], ["mark", "mark"]),
        ([(0.0, b"x")], []),
    ],
)
def test_a_held_key_is_one_mark_and_each_key_is_taken_when_pressed(
    typed: list[tuple[float, bytes]], told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    master, slave = os.openpty()
    session = Marks()
    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with keys(session):
            for wait_s, pressed in typed:
                time.sleep(wait_s)
                os.write(master, pressed)
            time.sleep(0.3)
        os.close(master)
    assert session.told == told


# --- setup -------------------------------------------------------------------------------------------------


class Gel(MjpegServer):
    """A camera whose gel can be touched."""

    def __init__(self, side: Side) -> None:
        reference = short_trial()[1][side]
        rng = np.random.default_rng(hash(side) % 2**32)
        pictures: list[ImageSample | PoseSample] = []
        for k in range(8):
            noisy = np.clip(reference + rng.normal(0, 1.5, reference.shape), 0, 255).astype(np.uint8)
            stamp = round(k / FPS * NS)
            pictures += [ImageSample("left", stamp, noisy), ImageSample("right", stamp, noisy)]
            pictures.append(PoseSample(stamp, np.eye(4)))
        self._calm = feed_from(pictures)
        self._pressed = feed_from(
            [
                ImageSample(
                    p.side, p.stamp_ns, cv2.circle(p.image.copy(), (160, 120), 70, (230, 230, 230), -1)
                )
                if isinstance(p, ImageSample)
                else p
                for p in pictures
            ]
        )
        super().__init__(side, self._calm, time.monotonic())

    def touch(self, touched: bool) -> None:
        """What is sent from now on."""
        new: Feed = self._pressed if touched else self._calm
        self._feed.jpegs[self._side][:] = new.jpegs[self._side]


def test_setup_learns_the_sides_by_touch_and_writes_the_rig(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gels: dict[Side, Gel] = {"left": Gel("left"), "right": Gel("right")}
    template = tmp_path / "nominal.yaml"
    template.write_text(dump_yaml(short_trial()[0]))
    out = tmp_path / "rig"
    calm = {side: list(gel._calm.jpegs[side]) for side, gel in gels.items()}

    def touch(side: Side) -> None:
        time.sleep(0.6)
        gels[side].touch(True)
        time.sleep(1.0)
        gels[side]._feed.jpegs[side][:] = calm[side]

    import rich.console

    say = rich.console.Console.print

    def listen(self: rich.console.Console, *text: object, **options: object) -> None:
        for side in SIDES:
            if str(text[0]).startswith(f"touch the {side}"):
                threading.Thread(target=touch, args=(side,), daemon=True).start()
        say(self, *text, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(rich.console.Console, "print", listen)
    addresses = ["--camera", gels["right"].url, "--camera", gels["left"].url]
    options = ["--from", str(template), "--out", str(out), "--no-crop", "--timeout", "20"]
    code, output, error = run("setup", *options, *addresses)
    assert code == 0, (output, error)
    rig = load_yaml(Rig, out / "rig.yaml")
    for side in SIDES:
        camera = rig.sensor(side).camera
        assert camera is not None
        assert camera.source == gels[side].url
        assert camera.size_px == (320, 240)
        reference = cv2.imread(str(out / f"reference_{side}.png"))
        assert np.abs(reference.astype(float) - short_trial()[1][side]).mean() < 3.0
        gels[side].close()
    _, _, error = run("setup", "--from", str(template), "--camera", "http://127.0.0.1:9/")
    assert isinstance(error, DeviceError)
    assert "two cameras are needed" in str(error)


def test_a_gel_model_beside_the_old_rig_file_is_found_from_the_new_one(tmp_path: Path) -> None:
    (tmp_path / "gel.onnx").write_bytes(b"a model")
    rig = short_trial()[0]
    left = rig.sensors.left.model_copy(update={"gel_model": "gel.onnx"})
    rig = rig.model_copy(update={"sensors": rig.sensors.model_copy(update={"left": left})})
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    (moved / "rig.yaml").write_text(dump_yaml(with_gel_models(rig, tmp_path)))
    folder = read_rig_folder(moved / "rig.yaml")
    assert list(folder.gel_models.values()) == [b"a model"]
    assert folder.rig.sensors.right.gel_model == rig.sensors.right.gel_model


def test_the_crop_keeps_the_aspect_ratio_and_the_middle() -> None:
    left, top, width, height = crop_for((640, 480), (320, 240))
    assert width / height == pytest.approx(4 / 3, rel=0.01)
    assert left == pytest.approx((640 - width) / 2, abs=1)
    assert top == pytest.approx((480 - height) / 2, abs=1)
    assert width == round(640 * 5 / 7)
