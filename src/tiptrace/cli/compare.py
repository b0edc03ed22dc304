"""``tiptrace compare``: repeats of one trial side by side, without ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.types import FloatArray, TipTrajectory

_SAMPLES = 200


def compare(
    results: Annotated[
        list[Path], typer.Argument(help="Two or more results folders of `tiptrace reconstruct`.")
    ],
) -> None:
    """Set repeats of one trial side by side: anchors, positions along the way, what each claims to know.

    Traces are compared at equal fractions of their way. A spread well beyond the claimed σ means that at least one
    repeat is wrong or that the repeats were not the same.

    Examples:

      tiptrace compare run1 run2 run3
    """
    import numpy as np
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from tiptrace.errors import ConfigError
    from tiptrace.outputs import read_results

    if len(results) < 2:
        raise ConfigError("compare needs at least two results folders")
    if len({folder.resolve() for folder in results}) < len(results):
        raise ConfigError(
            "a results folder is given more than once: it would agree with itself; leave it out"
        )
    traces = [read_results(folder) for folder in results]
    displaced = [f for f, t in zip(results, traces, strict=True) if _is_displacement(t)]
    if 0 < len(displaced) < len(results):
        raise ConfigError(
            f"{', '.join(map(str, displaced))}: displacements from the first contact, the others are positions in the "
            "base frame; compare only results of the same kind"
        )
    paths, sigmas = zip(*(_path(t, f) for t, f in zip(traces, results, strict=True)), strict=True)
    mean = np.mean(paths, axis=0)  # (samples, 3)
    table = Table(title="Repeats against their mean")
    for column in ("results", "anchor off mm", "trace off mm", "shape off mm", "claimed σ mm"):
        table.add_column(column, justify="left" if column == "results" else "right")
    anchors = [t.anchor.p_B if t.anchor is not None else None for t in traces]
    known = [a for a in anchors if a is not None]
    middle = np.mean(known, axis=0) if known else np.zeros(3)
    for folder, anchor, path, sigma in zip(results, anchors, paths, sigmas, strict=True):
        off = path - mean
        values = (
            f"{np.linalg.norm(anchor - middle) * 1e3:.2f}" if anchor is not None else "none",
            f"{_rms(off) * 1e3:.2f}",
            f"{_rms(off - off[0]) * 1e3:.2f}",
            f"{sigma * 1e3:.2f}" if np.isfinite(sigma) else "none",
        )
        table.add_row(escape(str(folder)), *values)
    console = Console()
    console.print(table)
    spread = _rms(np.asarray(paths) - mean) * float(np.sqrt(len(paths) / (len(paths) - 1)))
    known_sigmas = np.isfinite(sigmas).any()
    claimed = (
        f"claimed {float(np.nanmean(sigmas)) * 1e3:.2f} mm" if known_sigmas else "no method here claims a σ"
    )
    console.print(f"Spread of the repeats {spread * 1e3:.2f} mm rms, {claimed}.", highlight=False)


def _path(trajectory: TipTrajectory, folder: Path) -> tuple[FloatArray, float]:
    """Positions of Stage II at equal fractions of the way (samples, 3), and the mean claimed σ, m."""
    import numpy as np

    from tiptrace.errors import RecordingError
    from tiptrace.types import Phase

    rows = [e for e in trajectory.estimates if e.phase is Phase.RECONSTRUCTION and e.p_B is not None]
    if len(rows) < 2:
        raise RecordingError(
            f"{folder}: fewer than two positions in the reconstruction segment, nothing to compare"
        )
    p = np.array([e.p_B for e in rows])
    axis = np.linalg.svd(p - p.mean(axis=0))[2][0]  # along the way: noise does not lengthen a projection
    way = np.maximum.accumulate((p - p[0]) @ (axis * np.sign(axis @ (p[-1] - p[0]))))
    at = np.linspace(way[0], way[-1], _SAMPLES)
    forward = np.concatenate([[True], np.diff(way) > 0])
    path = np.stack([np.interp(at, way[forward], p[forward, k]) for k in range(3)], axis=1)
    traces = [float(np.trace(e.covariance)) for e in rows if e.covariance is not None]
    return path, float(np.sqrt(np.mean(traces))) if traces else float("nan")


def _is_displacement(trajectory: TipTrajectory) -> bool:
    """Whether positions are relative to the first contact."""
    from tiptrace.types import Status

    return any(e.status is Status.RELATIVE for e in trajectory.estimates)


def _rms(x: FloatArray) -> float:
    import numpy as np

    return float(np.sqrt(np.mean(np.sum(np.square(x), axis=-1))))
