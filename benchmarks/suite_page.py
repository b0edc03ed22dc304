"""Tables and figures of docs/results.md from the rows of the evaluated suites."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tiptrace.evaluation import figures_suite as draw
from tiptrace.evaluation import published, style
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import summarise
from tiptrace.evaluation.suite_store import SuiteStore
from tiptrace.evaluation.suite_tables import (
    analytic_table,
    correlation_table,
    coverage_table,
    sets_table,
    wins_table,
)
from tiptrace.evaluation.suite_values import aligned, methods_of, values_by_trial
from tiptrace.evaluation.tables import MISSING, Cell, Table, columns, mean_std, rows_of

BEGIN, END = "<!-- suite:begin -->", "<!-- suite:end -->"
LEVELS = ("clean", "nominal", "hard", "unseen")
_METRICS = (
    ("trajectory_rmse_mm", "trajectory RMSE"),
    ("shape_rmse_mm", "shape RMSE"),
    ("initial_contact_error_mm", "initial contact"),
    ("cross_track_rmse_mm", "cross-track"),
    ("along_track_rmse_mm", "along-track"),
    ("frechet_mm", "Fréchet"),
)
_FAILURES_SHOWN = 20


def write_page(
    page: Path, records: Sequence[TrialRecord], made: str, figures: Sequence[tuple[str, Path]]
) -> None:
    """Put the generated block between the marks of a page; at its end where it has none."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    block = "\n".join([BEGIN, *_block(records, made, figures, page), END])
    if BEGIN in text and END in text:
        head, rest = text.split(BEGIN, 1)
        text = head + block + rest.split(END, 1)[1]
    else:
        text = text.rstrip("\n") + "\n\n" + block + "\n"
    write_atomic(page, text)
    print(f"{page}: written")


def _block(
    records: Sequence[TrialRecord], made: str, figures: Sequence[tuple[str, Path]], page: Path
) -> list[str]:
    lines = [
        f"Evaluated on {made}; written by `benchmarks/suite_results.py` from `docs/data/suite.parquet`.",
        "",
    ]
    levels = [level for level in LEVELS if any(r.level == level for r in records)]
    lines += _markdown(_levels_table(records, levels))
    for caption, path in figures:
        lines += [f"![{caption}]({os.path.relpath(path, page.parent)})", "", f"*{caption}*", ""]
    lines += _markdown(_seeds_table(records))
    for level in levels:
        chosen = [r for r in records if r.level == level]
        lines += [f"### Level `{level}`", "", *_markdown(_overall(chosen, level))]
        lines += _markdown(_wins(chosen))
        if level == "nominal":
            lines += (
                _markdown(sets_table(chosen))
                + _markdown(_known_rho(chosen))
                + _markdown(analytic_table(chosen))
            )
        lines += _markdown(coverage_table(chosen)) + _failures(chosen)
    return lines


def _markdown(table: Table) -> list[str]:
    return [table.markdown()] if table.rows else []


def _count(records: Sequence[TrialRecord], method: str) -> str:
    trials = {r.trial: bool(r.failure) for r in records if r.method == method}
    lost = sum(trials.values())
    return f"{len(trials) - lost} of {len(trials)}" if lost else str(len(trials))


def _levels_table(records: Sequence[TrialRecord], levels: Sequence[str]) -> Table:
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        row: list[Cell] = [method]
        for level in levels:
            chosen = [r for r in records if r.level == level]
            s = summarise(list(values_by_trial(chosen, method, "trajectory_rmse_mm").values()))
            row.append(f"{mean_std(s.mean, s.std)} ({_count(chosen, method)})" if s.n else MISSING)
        rows.append(row)
    p = published.PUBLISHED["trajectory_rmse_mm"]
    rows.append(["paper, on hardware", *[MISSING] * (len(levels) - 1), f"{p.mean} ± {p.std} (51)"])
    heads = (("method", "method"), *((level, f"`{level}`") for level in levels))
    note = "The last row is what the paper reports for its hardware; it belongs to none of the levels."
    return Table(
        "levels", "Trajectory RMSE [mm] by level, mean ± std (trials)", columns(*heads), rows_of(rows), note
    )


def _seeds_table(records: Sequence[TrialRecord]) -> Table:
    suites = list(dict.fromkeys(r.trial.split("/")[0] for r in records))
    rows: list[list[Cell]] = []
    for suite in suites:
        chosen = [r for r in records if r.trial.split("/")[0] == suite]
        cells = []
        for method in ("full", "paper", "ee-only"):
            s = summarise(list(values_by_trial(chosen, method, "trajectory_rmse_mm").values()))
            cells.append(mean_std(s.mean, s.std))
        rows.append([suite, *cells])
    heads = (("suite", "suite"), *((m, f"`{m}`") for m in ("full", "paper", "ee-only")))
    title = "Does it hold with other seeds? Trajectory RMSE [mm] by suite (level-seed), mean ± std"
    return Table("seeds", title, columns(*heads), rows_of(rows) if len(suites) > len(LEVELS) else ())


def _overall(records: Sequence[TrialRecord], level: str) -> Table:
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        found = [summarise(list(values_by_trial(records, method, m).values())) for m, _ in _METRICS]
        t = found[0]
        spread = MISSING if t.n == 0 else f"{t.median:.2f} / {t.p95:.2f}"
        rows.append([method, _count(records, method), *(mean_std(s.mean, s.std) for s in found), spread])
    paper = [published.PUBLISHED.get(m) for m, _ in _METRICS]
    cells = [MISSING if p is None else mean_std(p.mean, p.std) for p in paper]
    rows.append(["paper, on hardware", "51", *cells, MISSING])
    heads = (
        *(("method", "method"), ("trials", "trials")),
        *_METRICS,
        ("median_p95", "trajectory, median / 95 %"),
    )
    return Table(
        "overall", f"Level {level}: errors in mm, mean ± std over trials", columns(*heads), rows_of(rows)
    )


def _wins(records: Sequence[TrialRecord]) -> Table:
    """``full`` against all others; a trial that only the other finished is a loss."""
    rows: list[list[Cell]] = []
    for rival in [m for m in methods_of(records) if m != "full"]:
        row: list[Cell] = [rival]
        for metric in ("trajectory_rmse_mm", "shape_rmse_mm", "cross_track_rmse_mm"):
            ours, theirs = aligned(records, ("full", rival), metric)
            known = np.isfinite(theirs)
            won = int(np.sum(np.where(np.isfinite(ours), ours, np.inf)[known] < theirs[known]))
            row.append(f"{won} of {int(known.sum())}")
        tests = [r for r in wins_table(records).records() if (r["method"], r["baseline"]) == ("full", rival)]
        rows.append([*row, tests[0]["p_value"] if tests else MISSING])
    heads = (
        *(("rival", "`full` better than"), ("trajectory", "trajectory"), ("shape", "shape")),
        *(("cross", "cross-track"), ("p", "p (trajectory, Wilcoxon)")),
    )
    note = "Trials in which `full` has the smaller error; one that it refused counts as lost."
    return Table("wins", "Trial by trial", columns(*heads), rows_of(rows), note)


def _known_rho(records: Sequence[TrialRecord]) -> Table:
    return correlation_table([r for r in records if r.method in ("full", "paper")])


def _failures(records: Sequence[TrialRecord]) -> list[str]:
    failed = [r for r in records if r.failure]
    if not failed:
        return ["No trial failed with any method.", ""]
    counts = Counter(r.method for r in failed)
    lines = [f"Failed: {', '.join(f'{n} with `{m}`' for m, n in counts.items())}.", ""]
    lines += [f"- `{r.trial}`, `{r.method}`: {r.failure}" for r in failed[:_FAILURES_SHOWN]]
    more = len(failed) - _FAILURES_SHOWN
    return [*lines, *([f"- and {more} more"] if more > 0 else []), ""]


def write_figures(
    folder: Path, records: Sequence[TrialRecord], traces: Path | None
) -> list[tuple[str, Path]]:
    """Figures of the level nominal, or of the first that there is; caption and path of each."""
    level = "nominal" if any(r.level == "nominal" for r in records) else records[0].level
    chosen = [r for r in records if r.level == level]
    n = len({r.trial for r in chosen})
    figures = {
        "suite_errors": (f"Part of {n} trials (level {level}) within an error.", draw.error_distribution),
        "suite_sets": (f"Shape error by condition set, {n} trials, level {level}.", draw.shape_by_set),
        "suite_anchoring": (
            f"Error against anchoring error, {n} trials, level {level}.",
            draw.error_against_anchoring,
        ),
    }
    done = []
    folder.mkdir(parents=True, exist_ok=True)
    with style.figure_style():
        for name, (caption, figure) in figures.items():
            done.append((caption, _saved(folder, name, figure(chosen))))
        suite = chosen[0].trial.split("/")[0]
        if traces is not None and (traces / suite).exists():
            store = SuiteStore(traces / suite)
            for method in ("full", "paper", "ee-only"):
                found = store.traces([r for r in chosen if r.trial.startswith(f"{suite}/")])
                caption = f"Traces of `{method}` over the true tip, suite {suite}, y stretched."
                done.append((caption, _saved(folder, f"suite_traces_{method}", draw.overlays(found, method))))
    return done


def _saved(folder: Path, name: str, figure: object) -> Path:
    figure.savefig(folder / f"{name}.png", dpi=110)  # type: ignore[attr-defined]
    return folder / f"{name}.png"
