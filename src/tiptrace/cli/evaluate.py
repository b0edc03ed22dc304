"""``tiptrace evaluate``: how accurate, how sure, compared with what, over any number of trials."""

from __future__ import annotations

import os
import shlex
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tiptrace.cli.options import MapFile, ReferenceFrames, RigFile

_MOST_REPORTS = 5

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
    ] = "full,paper,ee-only,ee-oracle,nominal-tip,local-anchoring",
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and report.html.")] = Path(
        "evaluation"
    ),
    level: Annotated[str, typer.Option(help="Of a suite: clean, nominal, hard or unseen.")] = "nominal",
    mode: Annotated[
        str, typer.Option(help="Of a suite: images or markers; default as the suite has it.")
    ] = "default",
    seed: Annotated[int, typer.Option(min=0, help="Of a suite.")] = 0,
    budget: Annotated[
        int,
        typer.Option(
            min=0, help="Also an error budget: trials with one disturbance at a time, so many of each."
        ),
    ] = 0,
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
    map_file: MapFile = None,
    rig: RigFile = None,
    reference_frames: ReferenceFrames = None,
) -> None:
    """Evaluate methods over trials and write tables, figures and a report; continues where it was stopped.

    Examples:

      tiptrace evaluate --suite quick --out quick

      tiptrace evaluate trials/ --methods full,paper,ee-only --workers 2 --out results

      tiptrace evaluate mine.mcap --truth mocap.tum --analytic T3 --start 0.4,-0.1,0.02
    """
    from rich.console import Console

    from tiptrace.errors import ConfigError
    from tiptrace.evaluation.inputs import with_content
    from tiptrace.evaluation.suite_store import SuiteStore
    from tiptrace.evaluation.suite_values import without_truth
    from tiptrace.evaluation.versions import library_versions
    from tiptrace.tracer import require_methods
    from tiptrace.trial_plan import recording_tasks, suite_tasks
    from tiptrace.trial_runs import inputs_of

    names = list(dict.fromkeys(m.strip() for m in methods.split(",") if m.strip()))
    require_methods(*names or [""])
    if bool(paths) == bool(suite):
        raise ConfigError("give recordings, or --suite paper|quick; not both, not neither")
    _check_curve(analytic, start)
    own = {"--truth": truth, "--map": map_file, "--rig": rig, "--reference-frames": reference_frames}
    if suite and any(own.values()):
        ours = ", ".join(name for name, value in own.items() if value)
        raise ConfigError(f"{ours}: a simulated suite has its own; leave it out, or give recordings")
    console = Console()
    settings = {"methods": ",".join(names), "analytic": analytic or "", "start": start or ""}
    if suite:
        tasks = suite_tasks(suite, level, mode, seed, analytic)
        settings |= {"suite": suite, "level": level, "mode": mode, "seed": str(seed)}
    else:
        given = {"map_file": map_file, "rig": rig, "reference_frames": reference_frames}
        options = {key: str(value) for key, value in given.items() if value is not None}
        known = {k: v if k == "reference_frames" else with_content(v) for k, v in options.items()}
        settings |= {"truth": str(truth or ""), **known}
        tasks, notes = recording_tasks(paths or [], truth, analytic, _start(start), options)
        for note in notes:
            console.print(f"note: {note}", highlight=False, markup=False)
    store = SuiteStore(out, {task.name: inputs_of(task) for task in tasks})
    store.claim({**settings, "tiptrace": library_versions().get("tiptrace", "")})
    workers = workers or os.cpu_count() or 1
    for task in tasks:
        if store.read(task.name) is None:
            _outlier_page(store, task).unlink(missing_ok=True)
    records = _run(tasks, names, store, workers, scheduler)
    records = _report_outliers(tasks, names, store, records)
    found = _run_budget(level, seed, budget, names, store, workers, scheduler)
    _show(console, records, _report(store, records, found, settings, suite))
    if any(r.failure for r in records) or without_truth(records):
        raise typer.Exit(1)


def _check_curve(analytic: str | None, start: str | None) -> None:
    """Before any work: a name that no trial can use would cost them all."""
    from tiptrace.errors import ConfigError
    from tiptrace.evaluation.analytic import CENTRELINES

    if analytic is not None and analytic not in ("auto", *CENTRELINES):
        raise ConfigError(f"unknown centreline '{analytic}'; valid: auto, {', '.join(CENTRELINES)}")
    if start is not None and analytic is None:
        raise ConfigError("--start is the start of an analytic centreline: give --analytic, too")


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


def _run_budget(
    level: str,
    seed: int,
    repeats: int,
    methods: list[str],
    store: SuiteStore,
    workers: int,
    scheduler: str | None,
) -> dict[str, list[TrialRecord]]:
    """Records with one disturbance at a time, by its name; nothing where none were asked for."""
    from tiptrace.evaluation.suite_store import SuiteStore
    from tiptrace.trial_plan import budget_tasks

    if repeats == 0:
        return {}
    plan = budget_tasks(level, seed, repeats)
    kept = SuiteStore(store.folder / "budget")
    kept.claim({"level": level, "seed": str(seed), "methods": ",".join(methods)})
    records = _run([task for tasks in plan.values() for task in tasks], methods, kept, workers, scheduler)
    of_trial = {task.name: name for name, tasks in plan.items() for task in tasks}
    return {name: [r for r in records if of_trial[r.trial] == name] for name in plan}


def _report_outliers(
    tasks: list[TrialTask], methods: list[str], store: SuiteStore, records: list[TrialRecord]
) -> list[TrialRecord]:
    """Run the worst trials again, each with a report of its own, and link them."""
    from dataclasses import replace

    from tiptrace.cli.show import progress_bar
    from tiptrace.errors import TipTraceError
    from tiptrace.evaluation.suite_values import outliers
    from tiptrace.trial_runs import report_trial

    worst = {r.trial for r in outliers(records, methods[0])[:_MOST_REPORTS]}
    links: dict[str, str] = {}
    with progress_bar() as progress:
        for task in progress.track([t for t in tasks if t.name in worst], description="reports of outliers"):
            page = _outlier_page(store, task)
            with suppress(TipTraceError):  # it is in the table of failures
                if page.exists() or report_trial(task, methods, page.parent) is not None:
                    links[task.name] = str(page.relative_to(store.folder))
    return [replace(r, report=links.get(r.trial, "")) for r in records]


def _outlier_page(store: SuiteStore, task: TrialTask) -> Path:
    from tiptrace.evaluation.suite_store import file_name

    return store.folder / "outliers" / file_name(task.name) / "report.html"


def _report(
    store: SuiteStore,
    records: list[TrialRecord],
    budget: dict[str, list[TrialRecord]],
    settings: dict[str, str],
    suite: str | None,
) -> Path:
    from tiptrace.evaluation.suite_report import SuiteData, write_suite_report
    from tiptrace.evaluation.suite_values import without_truth
    from tiptrace.evaluation.versions import library_versions

    store.finish(records)
    title = f"Suite {suite}, level {settings['level']}" if suite else "Evaluation of recordings"
    data = SuiteData(
        title=title,
        records=records,
        traces=lambda: store.traces(records),
        budget=budget,
        settings={k: v for k, v in settings.items() if v},
        versions=library_versions(),
        notes=tuple(f"{trial}: no ground truth, in no error below" for trial in without_truth(records)),
        command=shlex.join(["tiptrace", *sys.argv[1:]]),
    )
    return write_suite_report(store.folder, data)


def _show(console: Any, records: list[TrialRecord], page: Path) -> None:
    """Errors by method, narrow enough for 80 columns; failures by name."""
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    from tiptrace.evaluation.suite_side_tables import failures_table
    from tiptrace.evaluation.suite_values import without_truth
    from tiptrace.evaluation.terminal_table import terminal_table

    errors = terminal_table(records)
    if errors.rows:
        table = Table(title=escape(errors.title), box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for k, column in enumerate(errors.columns):
            table.add_column(column.heading, justify="left" if k == 0 else "right", no_wrap=True)
        for row in errors.text_rows():
            table.add_row(*row)
        console.print(table)
        console.print(errors.note, markup=False, highlight=False)
    for trial, method, reason in failures_table(records).text_rows():
        console.print(f"failed: {trial}, {method}: {reason}", markup=False, highlight=False, soft_wrap=True)
    for trial in without_truth(records):
        console.print(f"no ground truth: {trial}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"Report: {page}", markup=False, highlight=False, soft_wrap=True)
