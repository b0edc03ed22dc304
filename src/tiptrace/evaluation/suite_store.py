"""Results of a suite on disk, trial by trial, so that a run can be stopped and continued."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from tiptrace.errors import ConfigError, OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.inputs import file_states
from tiptrace.evaluation.records import TrialRecord, read_records, write_records
from tiptrace.evaluation.traces import TrialTraces

_SETTINGS = "suite.json"


class SuiteStore:
    """A folder with one small file per finished trial.

    ::

        DIR/
          suite.json            what the suite was set to
          records/TRIAL.parquet a row per method (.csv without pyarrow)
          records/TRIAL.json    size and time of the files that they come from, where there are any
          traces/TRIAL.npz      positions for the figures
          trials.parquet        all records, written at the end
    """

    def __init__(self, folder: Path, inputs: Mapping[str, Sequence[Path]] | None = None) -> None:
        """Use a folder; nothing is written yet.

        Args:
            folder: Where.
            inputs: Files that trials come from; a trial whose files have changed is not finished.
        """
        self.folder = folder
        self._inputs = inputs or {}
        self._suffix = ".parquet" if find_spec("pyarrow") else ".csv"

    def claim(self, settings: Mapping[str, str]) -> None:
        """Note the settings, or check that the folder holds results of the same.

        Raises:
            ConfigError: the folder holds results with other settings.
            OutputError: the folder cannot be written.
        """
        path = self.folder / _SETTINGS
        if path.exists():
            before = _load_settings(path)
            other = sorted(k for k in {*before, *settings} if before.get(k) != settings.get(k))
            if other:
                changes = ", ".join(f"{k} {before.get(k, '–')} → {settings.get(k, '–')}" for k in other)
                raise ConfigError(
                    f"{self.folder}: holds results with other settings ({changes}); choose another --out"
                )
        else:
            write_atomic(path, json.dumps(dict(settings), indent=1) + "\n")

    def write(self, trial: str, records: Iterable[TrialRecord], traces: TrialTraces | None) -> None:
        """Keep a finished trial; its records come last, so that they mean that all of it is there."""
        if traces is not None:
            traces.write(self._path("traces", trial, ".npz"))
        if inputs := self._inputs.get(trial):
            write_atomic(self._path("records", trial, ".json"), json.dumps(file_states(inputs)) + "\n")
        write_records(self._path("records", trial, self._suffix), records)

    def read(self, trial: str) -> list[TrialRecord] | None:
        """Records of a trial; None where it is not finished, its files have changed, or the record is damaged."""
        path = self._path("records", trial, self._suffix)
        if not self._unchanged(trial):
            return None
        try:
            return read_records(path) if path.exists() else None
        except OutputError:
            return None

    def traces(self, records: Iterable[TrialRecord]) -> Iterator[tuple[Condition, TrialTraces]]:
        """Traces of the trials whose condition is known, one at a time."""
        conditions = {r.trial: r.condition for r in records if r.condition is not None}
        for trial, condition in conditions.items():
            path = self._path("traces", trial, ".npz")
            if path.exists():
                yield condition, TrialTraces.read(path)

    def finish(self, records: Iterable[TrialRecord]) -> Path:
        """Write all records as one file; returns its path."""
        path = self.folder / f"trials{self._suffix}"
        write_records(path, records)
        return path

    def _unchanged(self, trial: str) -> bool:
        """Whether the files that a trial comes from are those that its records were made from."""
        inputs = self._inputs.get(trial)
        if not inputs:
            return True
        try:
            before = json.loads(self._path("records", trial, ".json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return bool(before == file_states(inputs))

    def _path(self, kind: str, trial: str, suffix: str) -> Path:
        return self.folder / kind / f"{file_name(trial)}{suffix}"


def _load_settings(path: Path) -> dict[str, str]:
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(before, dict):
            return before
    except (OSError, ValueError):
        pass
    raise OutputError(
        f"{path}: does not tell which settings the results beside it have; choose another --out"
    )


def file_name(trial: str) -> str:
    """A name that any file system takes, different for different trials."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", trial).strip("._")
    if plain == trial and len(plain) <= 80:
        return plain
    return f"{plain[-60:]}-{hashlib.sha256(trial.encode()).hexdigest()[:8]}"
