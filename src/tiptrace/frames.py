"""``frames.csv``: when the images were taken that each row of a ``trajectory.csv`` belongs to.

A row of the trajectory carries the instant of exposure, capture minus the latency in use, which the estimator may
learn in the trial. Whoever joins the tip to images needs the stamps that the recording has.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.pipeline import Step

FRAMES = "frames.csv"
FRAME_COLUMNS = ("stamp_ns", "left_stamp_ns", "right_stamp_ns")

Stamps = NDArray[np.int64]


class FrameWatch:
    """Notes the capture stamps of each pair; a viewer of the loop."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, int]] = []

    def show(self, step: Step) -> None:
        """Note one pair."""
        o = step.observation
        self._rows.append((o.stamp_ns, o.left.sample.stamp_ns, o.right.sample.stamp_ns))

    @property
    def stamps(self) -> Stamps:
        """(n, 3) of the pair (mean of both), the left and the right image, ns."""
        return np.array(self._rows, dtype=np.int64).reshape(-1, 3)


def write_frames(folder: Path, stamps: Stamps) -> None:
    """Write ``frames.csv`` into a results folder.

    Raises:
        OutputError: it cannot be written.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(FRAME_COLUMNS)
    writer.writerows(stamps.tolist())
    write_atomic(folder / FRAMES, buffer.getvalue())


def read_frames(folder: Path, rows: int) -> Stamps:
    """(rows, 3) capture stamps of a results folder, ns.

    Raises:
        OutputError: missing, damaged, or not of this trajectory.
    """
    path = folder / FRAMES
    try:
        lines = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except FileNotFoundError:
        raise OutputError(
            f"{path}: missing; reconstruct the recording again, or export the recording itself"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise OutputError(f"{path}: cannot be read ({error})") from None
    try:
        if tuple(_first(lines)) != FRAME_COLUMNS:
            raise ValueError(f"expected the columns {', '.join(FRAME_COLUMNS)}")
        stamps = np.array([[int(cell) for cell in line] for line in lines[1:]], dtype=np.int64).reshape(-1, 3)
    except ValueError as error:
        raise OutputError(f"{path}: cannot be understood ({error})") from None
    if len(stamps) != rows:
        raise OutputError(f"{path}: has {len(stamps)} rows, the trajectory beside it {rows}")
    return stamps


def _first(lines: Sequence[list[str]]) -> list[str]:
    return lines[0] if lines else []
