"""``tiptrace evaluate``: how accurate, how sure, compared with what, over any number of trials."""

from __future__ import annotations

import os
import shlex
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from tiptrace.evaluation.records import TrialRecord
    from tiptrace.evaluation.runner import TrialTask
    from tiptrace.evaluation.suite_store import SuiteStore


def evaluate(
    paths: Annotated[
        list[Path] | None, typer.Argument(help="Recordings, or folders of them, with ground truth.")
    ] = None,
    suite: Annotated[
        str | None, typer.Option(help="Simulate: paper (51, images) or quick (12, markers).")
    ] = None,
    methods: Annotated[
        str, typer.Option(help="Methods, comma-separated, the main one first.")
    ] = "paper,ee-only",
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and report.html.")] = Path(
        "evaluation"
    ),
    level: Annotated[str, typer.Option(help="Of a suite: clean, nominal, hard or unseen.")] = "nominal",
    mode: Annotated[
        str, typer.Option(help="Of a suite: images or markers; default as the suite has it.")
    ] = "default",
    seed: Annotated[int, typer.Option(min=0, help="Of a suite.")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0: one per core.")] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, e.g. tcp://node01:8786.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Ground truth: a TUM or csv file, or a folder with NAME.tum or NAME.csv each."),
    ] = None,
    analytic: Annotated[
        str | None,
        typer.Option(help="Also against an analytic centreline, T1–T5; `auto`: as the trial names it."),
    ] = None,
    start: Annotated[
        str | None, typer.Option(help="Measured start of the centreline: x,y,z in metres.")
    ] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="map.yaml for other people's recordings.")
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.yaml, in place of the attached ones.")] = None,
    reference_frames: Annotated[
        str | None, typer.Option(help="Frames that show the untouched gel, e.g. 0:20.")
    ] = None,
) -> None:
    """Evaluate methods over trials and write tables, figures and a report; continues where it was stopped.

    Examples:

      tiptrace evaluate --suite quick --out quick

      tiptrace evaluate trials/ --methods paper,ee-only --workers 2 --out results

      tiptrace evaluate mine.mcap --truth mocap.tum --analytic T3 --start 0.4,-0.1,0.02
    """
    from rich.console import Console

    from tiptrace.errors import ConfigError
    from tiptrace.evaluation.suite_store import SuiteStore

    names = [m.strip() for m in methods.split(",") if m.strip()]
    _check_methods(names)
    if bool(paths) == bool(suite):
        raise ConfigError("give recordings, or --suite paper|quick; not both, not neither")
    console, store = Console(), SuiteStore(out)
    settings = {"methods": ",".join(names), "analytic": analytic or "", "start": start or ""}
    if suite:
        tasks = _suite_tasks(suite, level, mode, seed, analytic)
        settings |= {"suite": suite, "level": level, "mode": mode, "seed": str(seed)}
    else:
        given = {"map_file": map_file, "rig": rig, "reference_frames": reference_frames}
        options = {key: str(value) for key, value in given.items() if value is not None}
        tasks, notes = _recording_tasks(paths or [], truth, analytic, start, options)
        for note in notes:
            console.print(f"note: {note}", highlight=False, markup=False)
    store.claim(settings)
    records = _run(tasks, names, store, workers or os.cpu_count() or 1, scheduler)
    page = _report(store, records, settings, suite)
    _show(console, records, page)
    if any(r.failure for r in records):
        raise typer.Exit(1)


def _check_methods(names: list[str]) -> None:
    from tiptrace.errors import ConfigError
    from tiptrace.tracer import METHODS

    unknown = [m for m in names if m not in METHODS]
    if unknown or not names:
        raise ConfigError(f"unknown method(s) {', '.join(unknown) or '–'}; valid: {', '.join(METHODS)}")


def _suite_tasks(suite: str, level: str, mode: Any, seed: int, analytic: str | None) -> list[TrialTask]:
    from tiptrace.evaluation.conditions import Condition
    from tiptrace.evaluation.runner import TrialTask
    from tiptrace.sim.suite import suite_trials
    from tiptrace.trial_runs import simulated_source

    tasks = []
    for trial in suite_trials(suite, level, mode, seed):
        spec = trial.spec
        condition = Condition(spec.trajectory, spec.tool, spec.wrist, spec.grasp)
        curve = {"centreline": spec.trajectory if analytic == "auto" else analytic} if analytic else None
        source = simulated_source(spec.model_dump(mode="json", exclude_none=True), curve)
        tasks.append(TrialTask(trial.name, source, condition, spec.level, spec.seed))
    return tasks


def _recording_tasks(
    paths: list[Path], truth: Path | None, analytic: str | None, start: str | None, options: dict[str, str]
) -> tuple[list[TrialTask], list[str]]:
    """Tasks in the order given, each file once; and what a user should know of them."""
    from tiptrace.trial_runs import recording_source, recording_task

    found, notes = _expand(paths)
    tasks = []
    for path in found:
        task = recording_task(path, str(path), "", options)
        curve = None
        if analytic is not None:
            name = task.condition.trajectory if analytic == "auto" and task.condition else analytic
            curve = {"centreline": name, "start_m": _start(start)}
        source = recording_source(path, _truth_of(path, truth), curve, options)
        tasks.append(type(task)(task.name, source, task.condition, task.level, task.seed))
    return tasks, notes


def _expand(paths: list[Path]) -> tuple[list[Path], list[str]]:
    """Recordings in folders; bags that are folders stay whole."""
    from tiptrace.errors import ConfigError

    found: dict[Path, Path] = {}
    notes = []
    for path in paths:
        is_bag = path.is_dir() and (path / "metadata.yaml").exists()
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() and not is_bag else [path]
        if not inside:
            raise ConfigError(f"{path}: holds no recording (*.mcap)")
        for recording in inside:
            if recording.resolve() in found:
                notes.append(f"{recording}: given more than once, evaluated once")
            found.setdefault(recording.resolve(), recording)
    return list(found.values()), notes


def _truth_of(recording: Path, truth: Path | None) -> Path | None:
    """Truth file of a recording: the file itself, or the one of its name in a folder."""
    if truth is None or not truth.is_dir():
        return truth
    named = (truth / f"{recording.stem}{suffix}" for suffix in (".tum", ".csv"))
    return next((path for path in named if path.exists()), None)


def _start(text: str | None) -> list[float] | None:
    from tiptrace.errors import ConfigError

    if text is None:
        return None
    try:
        start = [float(part) for part in text.split(",")]
    except ValueError:
        start = []
    if len(start) != 3:
        raise ConfigError(f"--start '{text}': expected x,y,z in metres")
    return start


def _run(
    tasks: list[TrialTask], methods: list[str], store: SuiteStore, workers: int, scheduler: str | None
) -> list[TrialRecord]:
    from tiptrace.cli.show import progress_bar
    from tiptrace.evaluation.executors import dask_executor, local_executor
    from tiptrace.evaluation.runner import SuiteRun
    from tiptrace.trial_runs import run_trial

    with ExitStack() as stack:
        workers = min(workers, max(1, len(tasks)))
        open_executor = (
            stack.enter_context(dask_executor(scheduler)) if scheduler else local_executor(workers)
        )
        progress = stack.enter_context(progress_bar())
        bar = progress.add_task("trials", total=len(tasks))
        run = SuiteRun(
            run_trial,
            methods,
            store,
            open_executor,
            in_flight=1000 if scheduler else 2 * workers,
            on_done=lambda _: progress.advance(bar),
        )
        return run.run(tasks)


def _report(
    store: SuiteStore, records: list[TrialRecord], settings: dict[str, str], suite: str | None
) -> Path:
    from tiptrace.evaluation.suite_report import SuiteData, write_suite_report
    from tiptrace.evaluation.versions import library_versions

    store.finish(records)
    title = f"Suite {suite}, level {settings['level']}" if suite else "Evaluation of recordings"
    data = SuiteData(
        title=title,
        records=records,
        traces=lambda: store.traces(records),
        settings={k: v for k, v in settings.items() if v},
        versions=library_versions(),
        command=shlex.join(["tiptrace", *sys.argv[1:]]),
    )
    return write_suite_report(store.folder, data)


def _show(console: Any, records: list[TrialRecord], page: Path) -> None:
    """Overall table with a row per metric, which fits a terminal; failures by name."""
    from rich.markup import escape
    from rich.table import Table

    from tiptrace.evaluation.suite_tables import failures_table, overall_table

    overall = overall_table(records)
    if overall.rows:
        by_metric = list(zip([c.heading for c in overall.columns], *overall.text_rows(), strict=True))
        table = Table(*(escape(cell) for cell in by_metric[0]), title=overall.title)
        for row in by_metric[1:]:
            table.add_row(*(escape(cell) for cell in row))
        console.print(table)
    for trial, method, reason in failures_table(records).text_rows():
        console.print(f"failed: {trial}, {method}: {reason}", markup=False, highlight=False)
    console.print(f"Report: {page}", markup=False, highlight=False)
