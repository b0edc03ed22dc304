"""track and depth as a user runs them."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

from tiptrace.cli.calibrate_check import calibrate_check
from tiptrace.cli.calibrate_gel import calibrate_gel
from tiptrace.cli.depth import depth
from tiptrace.cli.track import track
from tiptrace.errors import CalibrationError, OutputError, PerceptionError
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import untouched
from tiptrace.sim.optics import gel_optics
from tiptrace.sim.presses import render_press
from tiptrace.sim.render import TactileRenderer


@pytest.fixture(scope="module")
def renderer() -> TactileRenderer:
    return TactileRenderer(gel_optics(None), DotLayout(rows=7, columns=9), seed=1)


@pytest.fixture(scope="module")
def video(renderer: TactileRenderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "still.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (320, 240))
    for frame in range(5):
        writer.write(renderer.render(untouched(), frame))
    writer.release()
    return path


@pytest.mark.parametrize("method", ["full", "paper"])
def test_track_writes_a_row_per_marker_and_frame_under_fixed_numbers(
    video: Path, tmp_path: Path, method: str
) -> None:
    track(video, out=tmp_path / "tracks.csv", overlay=tmp_path / "tracks.mp4", method=method)  # type: ignore[arg-type]
    with (tmp_path / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["frame", "marker", "u_px", "v_px", "status"]
    assert len(rows) == 5 * 63
    places = np.array([[float(r["u_px"]), float(r["v_px"])] for r in rows]).reshape(5, 63, 2)
    assert np.abs(places - places[0]).max() < 0.3  # a still gel
    assert cv2.VideoCapture(str(tmp_path / "tracks.mp4")).read()[0]


def test_patch_is_a_column_of_its_own(video: Path, tmp_path: Path) -> None:
    track(video, out=tmp_path / "tracks.csv", patch=True)
    with (tmp_path / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["patch"] for row in rows} == {"1"}  # a still gel: nothing can be said, every marker counts


def test_outputs_that_cannot_be_written_are_told_before_the_work(video: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"tracks\.csv: cannot be written"):
        track(video, out=tmp_path / "file" / "tracks.csv")
    with pytest.raises(OutputError, match=r"gel\.onnx: cannot be written"):
        calibrate_gel(tmp_path, out=tmp_path / "file" / "gel.onnx")
    assert (tmp_path / "file").read_text() == ""


def test_track_does_not_write_over_its_video(video: Path, tmp_path: Path) -> None:
    before = video.read_bytes()
    with pytest.raises(OutputError, match="the video itself"):
        track(video, out=video)
    with pytest.raises(OutputError, match="the video itself"):
        track(video, out=tmp_path / "tracks.csv", overlay=video)
    with pytest.raises(OutputError, match="is --out"):
        track(video, out=tmp_path / "tracks.mp4", overlay=tmp_path / "tracks.mp4")
    assert video.read_bytes() == before


def test_tracks_that_fail_leave_the_former_table(video: Path, tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_text("before")
    with pytest.raises(OutputError, match=r"ends in \.mp4"):
        track(video, out=tmp_path / "tracks.csv", overlay=tmp_path / "tracks.txt")
    assert (tmp_path / "tracks.csv").read_text() == "before"
    assert not list(tmp_path.glob(".tracks*"))


def test_depth_takes_the_scale_of_the_gel_model(renderer: TactileRenderer, tmp_path: Path) -> None:
    press = render_press(renderer, (160.0, 120.0), ball_diameter_m=6e-3, depth_m=0.6e-3)
    cv2.imwrite(str(tmp_path / "press.png"), press.image)
    cv2.imwrite(str(tmp_path / "reference.png"), renderer.reference())
    maps = []
    for scale in (None, 0.0625, 0.125):
        depth(
            tmp_path / "press.png",
            reference=tmp_path / "reference.png",
            gel="gelsight-mini-virtual",
            mm_per_px=scale,
            out=tmp_path,
        )
        maps.append(np.load(tmp_path / "depth.npy"))
    assert np.array_equal(maps[0], maps[1])
    assert maps[2].max() == pytest.approx(2 * maps[0].max(), rel=0.05)


def test_check_says_what_is_missing_and_fails_on_wear(renderer: TactileRenderer, tmp_path: Path) -> None:
    reference, dim = tmp_path / "reference.png", tmp_path / "dim.png"
    cv2.imwrite(str(reference), renderer.reference())
    cv2.imwrite(str(dim), (renderer.reference() * 0.7).astype(np.uint8))
    with pytest.raises(CalibrationError, match="no image of the untouched gel; give --reference"):
        calibrate_check([dim], gel="gelsight-mini-virtual")
    calibrate_check([reference], reference=reference, gel="gelsight-mini-virtual")
    with pytest.raises(typer.Exit):
        calibrate_check([dim], reference=reference, gel="gelsight-mini-virtual")


def test_wear_that_a_contact_may_feign_is_told_so(
    renderer: TactileRenderer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference, pressed = tmp_path / "reference.png", tmp_path / "pressed.png"
    cv2.imwrite(str(reference), renderer.reference())
    press = render_press(renderer, (160.0, 120.0), ball_diameter_m=6e-3, depth_m=0.6e-3)
    cv2.imwrite(str(pressed), (press.image * 0.7).astype(np.uint8))
    with pytest.raises(typer.Exit):
        calibrate_check([pressed], reference=reference, gel="gelsight-mini-virtual")
    assert "check an image without contact" in capsys.readouterr().out


def test_a_video_without_markers_or_no_video_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "blank.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (320, 240))
    writer.write(np.full((240, 320, 3), 120, dtype=np.uint8))
    writer.release()
    with pytest.raises(PerceptionError, match=r"blank\.avi: first frame: .*marker"):
        track(path, out=tmp_path / "tracks.csv")
    with pytest.raises(PerceptionError, match=r"none\.avi: no such file"):
        track(tmp_path / "none.avi", out=tmp_path / "tracks.csv")
    (tmp_path / "text.avi").write_text("no video")
    with pytest.raises(PerceptionError, match="cannot be read as a video"):
        track(tmp_path / "text.avi", out=tmp_path / "tracks.csv")


@pytest.mark.parametrize("method", ["full", "paper"])
def test_depth_of_a_ball_press_is_metric_and_positive_inwards(
    renderer: TactileRenderer, tmp_path: Path, method: str
) -> None:
    press = render_press(renderer, (160.0, 120.0), ball_diameter_m=6e-3, depth_m=0.6e-3)
    cv2.imwrite(str(tmp_path / "press.png"), press.image)
    cv2.imwrite(str(tmp_path / "reference.png"), renderer.reference())
    depth(
        tmp_path / "press.png",
        reference=tmp_path / "reference.png",
        gel="gelsight-mini-virtual",
        mm_per_px=0.0625,
        out=tmp_path,
        method=method,  # type: ignore[arg-type]
        marker_threshold=(0.0, 50.0),
    )
    h = np.load(tmp_path / "depth.npy")
    assert h.shape == (240, 320)
    assert h[110:130, 150:170].max() == pytest.approx(0.6e-3, rel=0.15)
    assert abs(np.median(h[:40, :40])) < 5e-5
    assert (tmp_path / "depth.png").stat().st_size > 10_000


def test_image_and_reference_of_other_sizes_are_refused(renderer: TactileRenderer, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), renderer.reference())
    cv2.imwrite(str(tmp_path / "b.png"), renderer.reference()[:200])
    with pytest.raises(PerceptionError, match="differ in size"):
        depth(
            tmp_path / "a.png",
            reference=tmp_path / "b.png",
            gel="gelsight-mini-virtual",
            mm_per_px=0.06,
            out=tmp_path,
        )
