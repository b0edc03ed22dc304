"""Writes a session to disk in a thread of its own: synced every second, never over another file."""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tiptrace.config import Rig, Tool
from tiptrace.drivers.timeline import Timeline
from tiptrace.errors import RecordingError, TipTraceError
from tiptrace.streams.writer import RecordingWriter
from tiptrace.types import Image, Sample, Side

_SYNC_S = 1.0
_CHUNK_BYTES = 512 * 1024  # each costs 1 kB of index, held until the end; a sync ends one early
_QUEUE_BYTES = 64 * 1024 * 1024  # a minute of a disk that stands still
_POSE_BYTES = 200
_PATIENCE = 400  # samples that wait for a good time to be written
_MIN_FREE_BYTES = 500 * 1024 * 1024
_SPARE_BYTES = 20 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class RecorderState:
    """How the recording goes.

    Attributes:
        samples: Written.
        waiting: In the queue.
        dropped: Lost because the disk did not keep up.
        synced_s: Since the last sync.
        error: Why it ended early; empty while it is well.
    """

    samples: int
    waiting: int
    dropped: int
    synced_s: float
    error: str


class Recorder:
    """Context manager around a :class:`~tiptrace.streams.writer.RecordingWriter`.

    While it runs the file is ``<name>.partial.mcap``, readable as far as it was synced, whatever happens to the
    process. It takes its name when the session ends well. An error stops the recording, never the session: the file is
    closed and stays.

    Args:
        path: Target, ``*.mcap``.
        timeline: The session's; its offset to the wall clock is stored, and its error at every sync.
        rig: What the user believes about the rig.
        tool: What is known of the tool.
        references: Images of the untouched gels.
        gel_models: ONNX files by name.
        trial: Further metadata.
        min_free_bytes: Refuse to start with less free disk.

    Raises:
        RecordingError: on entering: the name is taken, or the disk is nearly full.
    """

    def __init__(
        self,
        path: Path,
        timeline: Timeline,
        *,
        rig: Rig,
        tool: Tool | None = None,
        references: Mapping[Side, Image] | None = None,
        gel_models: Mapping[str, bytes] | None = None,
        trial: Mapping[str, Any] | None = None,
        min_free_bytes: int = _MIN_FREE_BYTES,
    ) -> None:
        self.path, self._timeline, self._min_free = path, timeline, min_free_bytes
        clock = {"stamps": "monotonic clock plus offset_ns", "offset_ns": timeline.offset_ns}
        self._writer = RecordingWriter(
            path,
            rig=rig,
            tool=tool,
            references=references,
            gel_models=gel_models,
            trial={"recorded_live": True, "clock": clock, **(trial or {})},
            overwrite=False,
            chunk_bytes=_CHUNK_BYTES,
        )
        self._queue: deque[tuple[Sample, int, bytes | None]] = deque()
        self._bytes = self._samples = self._dropped = 0
        self._synced = time.monotonic()
        self._ready, self._stop = threading.Condition(), False
        self._error: TipTraceError | None = None
        self._thread: threading.Thread | None = None

    @property
    def error(self) -> TipTraceError | None:
        """Why the recording ended early; None while it is well."""
        return self._error

    @property
    def file(self) -> Path:
        """Where what was recorded is now."""
        return self.path if self.path.exists() else self._writer.partial_path

    def state(self) -> RecorderState:
        """How the recording goes."""
        synced_s = time.monotonic() - self._synced
        error = "" if self._error is None else str(self._error)
        return RecorderState(self._samples, len(self._queue), self._dropped, synced_s, error)

    def __enter__(self) -> Self:
        check_space(self.path, self._min_free)
        self._writer.__enter__()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what waits, close the file, give it its name.

        An early end of the recording is in :attr:`error`, not raised.
        """
        with self._ready:
            self._stop = True
            self._ready.notify()
        if self._thread is not None:
            self._thread.join()

    def __call__(self, sample: Sample, log_time_ns: int, jpeg: bytes | None) -> None:
        """Take a sample; returns at once (a :class:`~tiptrace.streams.live.Tap`)."""
        if self._error is not None:
            return
        size = _POSE_BYTES if jpeg is None else len(jpeg)
        with self._ready:
            if self._bytes + size > _QUEUE_BYTES:
                self._dropped += 1
                return
            self._queue.append((sample, log_time_ns, jpeg))
            self._bytes += size
            if len(self._queue) > _PATIENCE:
                self._ready.notify()

    def nudge(self) -> None:
        """Now is a good time to write; without that it is done five times a second."""
        with self._ready:
            self._ready.notify()

    # --- the thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while self._write_batch():
                if time.monotonic() - self._synced >= _SYNC_S:
                    self._sync()
            self._sync()
        except TipTraceError as error:
            self._fail(error)
            return
        try:
            self._writer.__exit__(None, None, None)
        except RecordingError as error:
            self._error = error

    def _write_batch(self) -> bool:
        """Write what waits; False when the session has ended and nothing is left."""
        with self._ready:
            if not self._queue and not self._stop:
                self._ready.wait(0.2)
            batch = list(self._queue)
            self._queue.clear()
            self._bytes = 0
            stopping = self._stop
        for sample, log_time_ns, jpeg in batch:
            self._writer.write(sample, log_time_ns=log_time_ns, encoded=jpeg)
        self._samples += len(batch)
        return bool(batch) or not stopping

    def _sync(self) -> None:
        check_space(self.path, _SPARE_BYTES)
        wall = {
            "timeline_ns": str(self._timeline.now_ns()),
            "wall_error_ns": str(self._timeline.wall_error_ns()),
        }
        self._writer.sync(wall)
        self._synced = time.monotonic()

    def _fail(self, error: TipTraceError) -> None:
        """Close what there is; it stays under its unfinished name."""
        with suppress(RecordingError):
            self._writer.__exit__(type(error), error, None)
        kept = self._writer.partial_path
        self._error = RecordingError(f"{error}; the recording ended, what was recorded so far is in {kept}")
        with self._ready:
            self._queue.clear()


def check_space(path: Path, least_bytes: int) -> None:
    """There must be room on the disk.

    Raises:
        RecordingError: there is not.
    """
    folder = path.parent
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if free < least_bytes:
        raise RecordingError(
            f"{path}: only {free / 1e6:.0f} MB are free on its disk, at least {least_bytes / 1e6:.0f} MB are needed: "
            "free some, or record elsewhere"
        )
