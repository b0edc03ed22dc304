"""``tiptrace track``: marker tracks of a tactile video."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    import cv2

    from tiptrace.perception.video import VideoFrame
    from tiptrace.types import BoolArray, FloatArray, Image


def track(
    video: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="Video of a gel with marker dots.")
    ],
    out: Annotated[
        Path, typer.Option(help="csv to write: frame, marker, u_px, v_px, status (tracked or lost).")
    ] = Path("tracks.csv"),
    overlay: Annotated[
        Path | None, typer.Option(help="Also write the video with the tracks drawn in (.mp4).")
    ] = None,
    method: Annotated[
        Literal["full", "paper"], typer.Option(help="full: drift-free; paper: plain Lucas–Kanade.")
    ] = "full",
    patch: Annotated[
        bool,
        typer.Option(
            "--patch",
            help="Also a column patch: 1 where a marker lies under the object, told from its motion alone, as "
            "'reconstruct --depth none' tells it.",
        ),
    ] = False,
) -> None:
    """Find the markers in a video's first frame and follow each under its own number.

    No gel model is needed. Lost markers keep their number and come back under it.

    Examples:

      tiptrace track press.avi --out tracks.csv --overlay tracks.mp4

      tiptrace track press.avi --patch
    """
    from tiptrace.cli.files import check_writable
    from tiptrace.cli.show import progress_bar
    from tiptrace.errors import OutputError
    from tiptrace.perception.planar import MotionPatch
    from tiptrace.perception.video import Video

    source = Video(video)
    taken = {video.resolve(): "the video itself"}
    for path, what in ((out, "--out"), (overlay, "--overlay")):
        if path is not None and (other := taken.setdefault(path.resolve(), what)) != what:
            raise OutputError(f"{what} {path}: is {other}; choose another name")
    for path in (out,) if overlay is None else (out, overlay):
        check_writable(path)
    with ExitStack() as stack:
        progress = stack.enter_context(progress_bar())
        whole = not out.is_symlink() and (out.is_file() or not out.exists())  # no device, as /dev/stdout
        unfinished = out.with_name(f".{out.name}.part") if whole else out
        if whole:  # a run that is stopped leaves no half of a table
            stack.callback(unfinished.unlink, missing_ok=True)
        table = stack.enter_context(unfinished.open("w", newline="\n"))
        table.write("frame,marker,u_px,v_px,status" + (",patch" if patch else "") + "\n")
        task = progress.add_task(f"tracking {video.name}", total=source.frame_count or None)
        drawing = None if overlay is None else stack.enter_context(_Overlay(overlay, source.fps))
        frames = lost = markers = 0
        motion: MotionPatch | None = None
        for frame in source.track(method):
            if patch and motion is None:
                motion = MotionPatch(frame.uv_px.copy())
            under = None if motion is None else motion.update(frame.uv_px, frame.tracked)
            table.writelines(_rows(frame, under))
            if drawing is not None:
                drawing.add(frame)
            frames, markers, lost = frame.index + 1, len(frame.uv_px), int((~frame.tracked).sum())
            progress.advance(task)
        table.close()
        if whole:
            unfinished.replace(out)
    typer.echo(f"{out}: {markers} markers in {frames} frames, {lost} lost at the end")


def _rows(frame: VideoFrame, patch: BoolArray | None) -> list[str]:
    rows = []
    for marker, ((u, v), tracked) in enumerate(zip(frame.uv_px, frame.tracked, strict=True)):
        place = f"{u:.3f},{v:.3f},tracked" if tracked else ",,lost"
        under = "" if patch is None else f",{int(patch[marker])}"
        rows.append(f"{frame.index},{marker},{place}{under}\n")
    return rows


class _Overlay:
    """Writes the video enlarged, each marker with an arrow from where it started."""

    _ZOOM, _SHIFT = 3, 4
    _START, _NOW, _LOST = (230, 230, 230), (0, 159, 230), (0, 94, 213)  # BGR

    def __init__(self, path: Path, fps: float) -> None:
        import cv2

        self._cv2, self._path, self._fps = cv2, path, fps
        self._writer: cv2.VideoWriter | None = None
        self._start: FloatArray | None = None
        self._last: FloatArray | None = None

    def __enter__(self) -> _Overlay:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.release()

    def add(self, frame: VideoFrame) -> None:
        """Draw and write one frame."""
        import numpy as np

        if self._start is None or self._last is None:
            self._start, self._last = frame.uv_px.copy(), frame.uv_px.copy()
        self._last = np.where(frame.tracked[:, None], frame.uv_px, self._last)
        size = (frame.image.shape[1] * self._ZOOM, frame.image.shape[0] * self._ZOOM)
        picture: Image = np.asarray(
            self._cv2.resize(frame.image, size, interpolation=self._cv2.INTER_CUBIC), dtype=np.uint8
        )
        for start, now, tracked in zip(self._start, self._last, frame.tracked, strict=True):
            colour = self._NOW if tracked else self._LOST
            a, b = self._place(start), self._place(now)
            self._cv2.line(picture, a, b, self._START, 1, self._cv2.LINE_AA, self._SHIFT)
            self._cv2.circle(picture, b, 4 << self._SHIFT, colour, 2, self._cv2.LINE_AA, self._SHIFT)
        self._open(size).write(picture)

    def _place(self, uv_px: FloatArray) -> tuple[int, int]:
        """Pixel of the enlarged picture in fixed point."""
        u, v = ((uv_px + 0.5) * self._ZOOM - 0.5) * (1 << self._SHIFT)
        return round(float(u)), round(float(v))

    def _open(self, size: tuple[int, int]) -> cv2.VideoWriter:
        from tiptrace.errors import OutputError

        if self._writer is None:
            code = self._cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = self._cv2.VideoWriter(str(self._path), code, self._fps, size)
            if not self._writer.isOpened():
                raise OutputError(f"{self._path}: cannot be written as a video; use a name that ends in .mp4")
        return self._writer
