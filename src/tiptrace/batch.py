"""Any number of recordings, each to a results folder of its own, and a table of them all.

::

    DIR/
      suite.json        what the batch was set to; other settings are refused
      NAME/             as of one recording (docs/data.md), and
        summary.json    its row of the table; written last: it means that the recording is done
      summary.parquet   a row per recording of all shards that is done (.csv without pyarrow)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tiptrace
from tiptrace.batch_plan import NamedPath, share
from tiptrace.errors import OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.executors import OpenExecutor, local_executor
from tiptrace.evaluation.inputs import file_state, with_content
from tiptrace.evaluation.records import TrialRecord, from_row, to_row
from tiptrace.evaluation.runner import SuiteRun, TrialRun, TrialTask
from tiptrace.evaluation.suite_store import SuiteStore
from tiptrace.evaluation.summary_table import write_table
from tiptrace.evaluation.traces import TrialTraces
from tiptrace.frames import FRAMES
from tiptrace.grasp_file import GRASP
from tiptrace.outputs import CSV, EVENTS, METRICS, TUM
from tiptrace.reconstruction import reconstruct
from tiptrace.streams.sources import open_recording
from tiptrace.trial_runs import described
from tiptrace.using import Using

SUMMARY = "summary.json"
_REPORT = "report.html"
_PLAIN_OPTIONS = {"reference_frames", "stamps"}


@dataclass(frozen=True, slots=True)
class BatchSettings:
    """What is done with every recording.

    Attributes:
        method: Method that the files hold.
        beside: Further methods for the reports.
        report: Whether each recording gets a ``report.html``.
        options: Further arguments of ``open_recording``, as text.
        using: What stands in for Stage I or the gel network, and whether to smooth.
    """

    method: str = "full"
    beside: tuple[str, ...] = ()
    report: bool = False
    options: Mapping[str, str] | None = None
    using: Using = field(default_factory=Using)

    def claim(self) -> dict[str, str]:
        """What results in the same folder must have in common; an edited rig.yaml is another."""
        common = {"method": self.method, "beside": ",".join(self.beside), "report": str(self.report)}
        given = {k: v if k in _PLAIN_OPTIONS else with_content(v) for k, v in (self.options or {}).items()}
        given |= self.using.as_text()
        if self.using.tip is not None:
            given["tip"] = with_content(self.using.tip)
        if (other := self.using.anchor_from) is not None:
            given["anchor_from"] = with_content(other, other / GRASP if other.is_dir() else None)
        return {"batch": "reconstruct", **common, **given, "tiptrace": tiptrace.__version__}


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What came of a share of a batch.

    Attributes:
        records: One per recording of the share.
        kept: How many were done before.
        summary: Table of all shares so far.
    """

    records: tuple[TrialRecord, ...]
    kept: int
    summary: Path

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Name and reason of each that failed."""
        return [(r.trial, r.failure) for r in self.records if r.failure]


def run_batch(
    recordings: Sequence[NamedPath],
    settings: BatchSettings,
    out: Path,
    *,
    workers: int = 1,
    shard: tuple[int, int] = (1, 1),
    on_done: Callable[[str], None] = lambda name: None,
    open_executor: OpenExecutor | None = None,
) -> BatchResult:
    """Reconstruct a share of the recordings; what was done before is kept, what failed is tried again.

    Args:
        recordings: All recordings of the batch, of all shards.
        settings: What to do with each.
        out: Folder for the results.
        workers: Processes, each with one thread.
        shard: Which share, ``(i, n)`` counted from 1.
        on_done: Called with the name of each recording, those done before included.
        open_executor: Where they run, in place of processes of this machine.

    Raises:
        ConfigError: the folder holds results with other settings.
        OutputError: the folder cannot be written.
    """
    settings.using.check(settings.method, settings.beside)
    store = BatchStore(out, recordings)
    store.claim(settings.claim())
    tasks = [_task(item, settings, out) for item in share(recordings, shard)]
    kept = sum(store.done(task.name) for task in tasks)
    run = SuiteRun(
        reconstruct_trial,
        [settings.method],
        store,
        open_executor or local_executor(max(2, workers)),  # one worker too is a process: it may be killed
        in_flight=2 * workers if workers > 1 else 1,
        on_done=lambda task: on_done(task.name),
    )
    records = tuple(run.run(tasks))
    return BatchResult(records, kept, store.summarise())


def reconstruct_trial(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """Reconstruct one recording into its folder; workers call this by name.

    Raises:
        TipTraceError: the recording cannot give a trajectory.
    """
    source = json.loads(task.source)
    path, folder = Path(source["path"]), Path(source["folder"])
    for name in (
        SUMMARY,
        TUM,
        CSV,
        EVENTS,
        METRICS,
        _REPORT,
        FRAMES,
        GRASP,
    ):  # nothing stale beside a failure
        (folder / name).unlink(missing_ok=True)
    options: dict[str, Any] = {k: v if k in _PLAIN_OPTIONS else Path(v) for k, v in source["options"].items()}
    stream = open_recording(path, **options)
    result = reconstruct(
        stream,
        folder,
        methods[0],
        beside=source["beside"],
        report=source["report"],
        title=task.name,
        source=path.name,
        threads=False,
        using=Using.from_text(source["using"]),
    )
    trajectories = {methods[0]: result.methods[0].trajectory}
    return TrialRun(trajectories, result.truth, task=described(task, stream.trial))


class BatchStore(SuiteStore):
    """Rows of a batch, each in the results folder of its recording."""

    def __init__(self, folder: Path, recordings: Iterable[NamedPath]) -> None:
        super().__init__(folder)
        self._paths = {item.name: item.path for item in recordings}

    def write(self, trial: str, records: Iterable[TrialRecord], traces: TrialTraces | None) -> None:
        """Keep the row of a recording that is done."""
        (record,) = records
        folder, path = self.folder / trial, self._paths[trial]
        reasons: list[str] = []
        if not record.failure:
            quality = json.loads((folder / METRICS).read_text(encoding="utf-8"))["quality"]
            record, reasons = replace(record, verdict=quality["verdict"]), quality["reasons"]
        if (folder / _REPORT).exists():
            record = replace(record, report=f"{trial}/{_REPORT}")
        row = {"recording": str(path), **to_row(record), "reasons": "; ".join(reasons)}
        row = {name: value for name, value in row.items() if not name.startswith("analytic_")}
        write_atomic(folder / SUMMARY, json.dumps({"state": file_state(path), "row": row}, indent=1) + "\n")

    def read(self, trial: str) -> list[TrialRecord] | None:
        """The row of a recording; None where it is not done, or where the file has changed since."""
        found = self._load(trial)
        if found is None or found["state"] != file_state(self._paths[trial]):
            return None
        try:
            return [from_row(_Known(found["row"]))]
        except (KeyError, TypeError, ValueError):
            return None

    def done(self, trial: str) -> bool:
        """Whether a recording need not be run again."""
        records = self.read(trial)
        return records is not None and not records[0].failure

    def summarise(self) -> Path:
        """Write the table; jobs that end at the same time each see to it that it is complete."""
        path = self.folder / f"summary{self._suffix}"
        rows = self._rows()
        while True:
            write_table(path, rows)
            now = self._rows()
            if now == rows:
                return path
            rows = now

    def _rows(self) -> list[dict[str, Any]]:
        found = (self._load(name) for name in self._paths)
        return [f["row"] for f in found if f is not None]

    def _load(self, trial: str) -> dict[str, Any] | None:
        path = self.folder / trial / SUMMARY
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OutputError(f"{path}: cannot be read ({error.strerror})") from None
        except ValueError:
            return None
        return found if isinstance(found, dict) and {"state", "row"} <= found.keys() else None


class _Known(dict[str, Any]):
    """A row without the columns that a batch never has."""

    def __missing__(self, name: str) -> None:
        if not name.startswith("analytic_"):
            raise KeyError(name)


def _task(item: NamedPath, settings: BatchSettings, out: Path) -> TrialTask:
    source = {
        "path": str(item.path),
        "folder": str(out / item.name),
        "report": settings.report,
        "beside": list(settings.beside),
        "options": dict(settings.options or {}),
        "using": settings.using.as_text(),
    }
    return TrialTask(item.name, json.dumps(source))
