"""The suites of docs/results.md: evaluate folders of simulated trials, keep a row per trial and method, write the page.

    tiptrace simulate --suite paper --level nominal --seed 10 --out suite/nominal-10
    python benchmarks/suite_results.py evaluate suite/* --out evaluated --workers 2
    python benchmarks/suite_results.py gather evaluated --data docs/data/suite.parquet
    python benchmarks/suite_results.py page --data docs/data/suite.parquet --traces evaluated

A folder is named LEVEL-SEED; ``evaluate`` continues where it was stopped. ``page`` writes the tables between the marks
``<!-- suite:begin -->`` and ``<!-- suite:end -->`` of docs/results.md from the Parquet file alone; with ``--traces``
the overlays are drawn too.
"""

from __future__ import annotations

import argparse
import datetime as dt
import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from suite_page import write_figures, write_page

from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.executors import local_executor
from tiptrace.evaluation.records import TrialRecord, read_records, to_row
from tiptrace.evaluation.runner import SuiteRun
from tiptrace.evaluation.suite_store import SuiteStore
from tiptrace.evaluation.versions import library_versions
from tiptrace.tracer import METHODS
from tiptrace.trial_plan import recording_tasks
from tiptrace.trial_runs import run_trial

_DECIMALS = 4  # decimals kept of millimetres: a tenth of a micrometre


def evaluate(folders: list[Path], out: Path, methods: list[str], workers: int) -> None:
    """All trials of all folders with all methods, each kept as it is done."""
    for folder in folders:
        store = SuiteStore(out / folder.name)
        store.claim({"methods": ",".join(methods), "analytic": "auto"})
        found, _ = recording_tasks([folder], None, "auto", None, {})
        level = folder.name.rsplit("-", 1)[0]  # a trial that fails does not come to tell its own
        tasks = [replace(t, name=f"{folder.name}/{Path(t.name).stem}", level=level) for t in found]
        done = 0

        def report(task: object, folder: Path = folder, total: int = len(tasks)) -> None:
            nonlocal done
            done += 1
            print(f"{dt.datetime.now():%H:%M:%S} {folder.name}: {done} of {total}", flush=True)

        run = SuiteRun(
            run_trial, methods, store, local_executor(workers), in_flight=2 * workers, on_done=report
        )
        records = run.run(tasks)
        store.finish(records)
        for record in records:
            if record.failure:
                print(f"failed: {record.trial}, {record.method}: {record.failure}", flush=True)


def gather(out: Path, data: Path) -> None:
    """One small file of all records: single precision, a tenth of a micrometre."""
    records = [r for path in sorted(out.glob("*/trials.parquet")) for r in read_records(path)]
    if not records:
        raise SystemExit(f"{out}: holds no evaluated suite")
    data.parent.mkdir(parents=True, exist_ok=True)
    content = compact(records)
    write_atomic(data, content)
    print(f"{data}: {len(records)} rows, {len(content) / 1000:.0f} kB")


def compact(records: list[TrialRecord]) -> bytes:
    """Parquet bytes that ``read_records`` understands."""
    rows = [
        {k: round(v, _DECIMALS) if isinstance(v, float) else v for k, v in to_row(record).items()}
        for record in records
    ]
    names = list(rows[0])
    text = {n for n in names if any(isinstance(r[n], str) for r in rows)}
    whole = {n for n in names if n not in text and all(r[n] is None or isinstance(r[n], int) for r in rows)}
    kinds = {n: pa.string() if n in text else pa.int32() if n in whole else pa.float32() for n in names}
    about = {
        "made": f"{dt.date.today()}",
        "versions": library_versions(),
        "units": "as the column's name says; a row per trial and method; trials are named LEVEL-SEED/CONDITION-REPEAT",
    }
    schema = pa.schema(list(kinds.items()), {"tiptrace": json.dumps(about)})
    buffer = io.BytesIO()
    pq.write_table(
        pa.Table.from_pylist(rows, schema=schema),
        buffer,
        compression="zstd",
        compression_level=19,
        use_dictionary=sorted(text | whole),
        use_byte_stream_split=sorted(set(names) - text - whole),
    )
    return buffer.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    first = commands.add_parser("evaluate")
    first.add_argument("folders", type=Path, nargs="+")
    first.add_argument("--out", type=Path, required=True)
    first.add_argument("--methods", default=",".join(METHODS))
    first.add_argument("--workers", type=int, default=2)
    second = commands.add_parser("gather")
    second.add_argument("out", type=Path)
    second.add_argument("--data", type=Path, default=Path("docs/data/suite.parquet"))
    third = commands.add_parser("page")
    third.add_argument("--data", type=Path, default=Path("docs/data/suite.parquet"))
    third.add_argument("--page", type=Path, default=Path("docs/results.md"))
    third.add_argument("--images", type=Path, default=Path("docs/images"))
    third.add_argument("--traces", type=Path, help="where the suites were evaluated")
    args = parser.parse_args()
    if args.command == "evaluate":
        evaluate(args.folders, args.out, args.methods.split(","), args.workers)
    elif args.command == "gather":
        gather(args.out, args.data)
    else:
        about = json.loads(pq.read_schema(args.data).metadata[b"tiptrace"])
        records = read_records(args.data)
        figures = write_figures(args.images, records, args.traces)
        write_page(args.page, records, about["made"], figures)


if __name__ == "__main__":
    sys.exit(main())
