"""The examples of docs/data.md work as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from tiptrace.config import Rig, Tool
from tiptrace.evaluation.metrics import TrialMetrics
from tiptrace.outputs import COLUMNS
from tiptrace.streams.mapping import MapFile
from tiptrace.streams.recording import STANDARD_TOPICS
from tiptrace.types import Status

PAGE = Path(__file__).parents[2] / "docs" / "data.md"
TEXT = PAGE.read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.parametrize(("model", "tag"), [(Rig, "rig"), (Tool, "tool"), (MapFile, "map")])
def test_settings_files_are_valid(model: type[Rig | Tool | MapFile], tag: str) -> None:
    (block,) = (b for b in blocks("yaml") if b.startswith(f"format: tiptrace-{tag}/1"))
    model.model_validate(yaml.safe_load(block))


def test_the_program_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (rig,) = (b for b in blocks("yaml") if b.startswith("format: tiptrace-rig/1"))
    (tmp_path / "rig.yaml").write_text(rig)
    monkeypatch.chdir(tmp_path)
    (program,) = blocks("python")
    exec(compile(program, str(PAGE), "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) == 50


def test_all_topics_columns_and_states_are_named() -> None:
    assert all(f"`{topic}`" in TEXT for topic in STANDARD_TOPICS.roles())
    assert re.sub(r"\s+", " ", ", ".join(COLUMNS)) in re.sub(r"\s+", " ", TEXT)
    assert all(f"| `{status.value}` |" in TEXT for status in Status)
    for name in re.findall(r"\w+_rmse_mm", TEXT):
        assert name in TrialMetrics.__dataclass_fields__
