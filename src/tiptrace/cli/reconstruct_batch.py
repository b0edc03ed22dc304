"""``tiptrace reconstruct`` over many recordings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from tiptrace.batch import BatchSettings


def reconstruct_batch(
    paths: Sequence[Path], settings: BatchSettings, out: Path, workers: int | None, shard: str | None
) -> None:
    """Reconstruct all recordings under paths, print what failed; exit code 1 if any did."""
    from rich.console import Console

    from tiptrace.batch import run_batch
    from tiptrace.batch_plan import find_recordings, parse_shard, share
    from tiptrace.cli.show import progress_bar

    part = parse_shard(shard) if shard else (1, 1)
    found = find_recordings(paths, bags="map_file" in (settings.options or {}))
    console = Console(highlight=False, markup=False, soft_wrap=True)
    for note in found.notes:
        console.print(f"note: {note}")
    mine = len(share(found.recordings, part))
    processes = max(1, min(workers or os.cpu_count() or 1, mine))
    with progress_bar() as progress:
        bar = progress.add_task("recordings", total=mine)
        result = run_batch(
            found.recordings,
            settings,
            out,
            workers=processes,
            shard=part,
            on_done=lambda _: progress.advance(bar),
        )
    failures = [*result.failures, *found.empty]
    for name, reason in failures:
        console.print(f"failed: {name}: {reason}")
    done = len(result.records) - len(result.failures)
    before = f", {result.kept} of them before" if result.kept else ""
    console.print(f"{done} of {mine} recordings reconstructed{before}; table: {result.summary}")
    if failures:
        raise typer.Exit(1)
