"""What really happened in a trial of the virtual rig: losses of contact and slips, from the truth of every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.errors import MissingExtraError, RecordingError
from tiptrace.sim.simulation import START_NS, Frame
from tiptrace.types import BoolArray, Event, FloatArray, Phase

LOSS_S = 0.2  # shorter losses need not be told
SLIP_DEG, SLIP_M, SLIP_WINDOW_S = 1.5, 0.5e-3, 0.5  # of the tool against the pads, within the window
_SLIGHT = 1.0 / 3.0  # of a slip that need not be told, and is no false alarm either
_COLUMNS = ("exposure_ns", "phase", "in_contact", "slip_deg", "slip_m")


@dataclass(frozen=True, slots=True)
class TrueEvents:
    """Events of a trial.

    Attributes:
        events: Losses of contact in the reconstruction segment, from 0.2 s on, and slips of 1.5° or 0.5 mm within
            half a second.
        slight: Shorter losses and slips of at least a third of that: neither missed nor false.
    """

    events: tuple[Event, ...]
    slight: tuple[Event, ...]


def truth_table_of(recording: Path) -> Path:
    """Where ``tiptrace simulate --suite … --truth`` leaves the truth of a recording's frames."""
    whole = recording.absolute()  # `.` has no name
    return whole.with_name(f"{whole.stem}.truth.parquet")


def from_frames(frames: Sequence[Frame]) -> TrueEvents:
    """Of a trial that was just simulated."""
    states = [f.state for f in frames]
    return _events(
        np.array([START_NS + round(s.t_s * 1e9) for s in states], dtype=np.int64),
        np.array([s.in_contact for s in states], dtype=bool),
        np.array([s.phase is Phase.RECONSTRUCTION for s in states], dtype=bool),
        np.array([s.slip_deg for s in states], dtype=np.float64),
        np.array([s.slip_m for s in states], dtype=np.float64),
    )


def from_table(path: Path) -> TrueEvents:
    """Of a trial whose truth was written beside its recording.

    Raises:
        RecordingError: no table of this kind.
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingExtraError("pyarrow", "tables") from None
    try:
        rows: dict[str, list[Any]] = pq.read_table(path, columns=list(_COLUMNS)).to_pydict()
        missing = [name for name in _COLUMNS if name not in rows]
        if missing:
            raise RecordingError(
                f"{path}: not the truth of a simulated trial, column '{missing[0]}' is missing"
            )
        return _events(
            np.array(rows["exposure_ns"], dtype=np.int64),
            np.array(rows["in_contact"], dtype=bool),
            np.array([phase == Phase.RECONSTRUCTION.value for phase in rows["phase"]], dtype=bool),
            np.array(rows["slip_deg"], dtype=np.float64),
            np.array(rows["slip_m"], dtype=np.float64),
        )
    except (OSError, pa.ArrowException, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: not the truth of a simulated trial ({error})") from None


def _events(
    at_ns: np.ndarray, in_contact: BoolArray, tracing: BoolArray, slip_deg: FloatArray, slip_m: FloatArray
) -> TrueEvents:
    """From columns of one row per frame, (T,) each."""
    if len(at_ns) < 2:
        return TrueEvents((), ())
    frame_s = float(np.median(np.diff(at_ns))) * 1e-9
    events: list[Event] = []
    slight: list[Event] = []
    for a, b in _runs(~in_contact & tracing):
        long = (at_ns[b] - at_ns[a]) * 1e-9 + frame_s > LOSS_S
        (events if long else slight).append(Event("contact-lost", int(at_ns[a]), int(at_ns[b]), "true"))
    n = max(round(SLIP_WINDOW_S / frame_s), 1)
    turn, shift = np.abs(slip_deg[n:] - slip_deg[:-n]), slip_m[n:] - slip_m[:-n]
    for share, found in ((1.0, events), (_SLIGHT, slight)):
        for a, b in _runs((turn > share * SLIP_DEG) | (shift > share * SLIP_M)):
            found.append(Event("grasp-slip", int(at_ns[a]), int(at_ns[b + n]), "true"))
    return TrueEvents(tuple(events), tuple(slight))


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
