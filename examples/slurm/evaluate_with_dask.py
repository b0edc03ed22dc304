"""Starts a Dask cluster out of SLURM jobs and evaluates on it.

    pip install 'tiptrace[cluster]'
    python evaluate_with_dask.py --queue cpu --jobs 32 -- --suite paper --methods full,paper,ee-only --out paper

What stands after ``--`` goes to ``tiptrace evaluate``. The scheduler runs here, on a login or head node that the
nodes can reach. Workers join as SLURM starts them; a job that is killed costs only the trial that it had, which is run
again. The exit code is that of ``tiptrace evaluate``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

from dask_jobqueue import SLURMCluster

# Each worker runs one trial at a time in one thread, those that join late too.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--queue", help="SLURM partition; default: the cluster's")
    parser.add_argument("--account", help="SLURM account")
    parser.add_argument("--jobs", type=int, default=8, help="workers, each a job with one core")
    parser.add_argument("--memory", default="2GB", help="of each")
    parser.add_argument("--walltime", default="04:00:00")
    parser.add_argument("evaluate", nargs="+", help="after --: arguments of tiptrace evaluate")
    args = parser.parse_args()
    with SLURMCluster(
        queue=args.queue,
        account=args.account,
        cores=1,
        processes=1,
        memory=args.memory,
        walltime=args.walltime,
        job_script_prologue=[f"export {name}=1" for name in ONE_THREAD],
    ) as cluster:
        cluster.scale(jobs=args.jobs)
        command = ["tiptrace", "evaluate", *args.evaluate, "--scheduler", cluster.scheduler_address]
        return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
