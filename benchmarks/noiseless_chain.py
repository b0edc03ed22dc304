"""What error the sensing chain alone leaves: noiseless images of the virtual rig against its true markers.

    python benchmarks/noiseless_chain.py [--seed 1000] [--methods paper full]

For T1 and T3 a trial without any disturbance, camera noise or jpeg is traced twice: from its images, and from the
true 3-D positions of the same dots. The difference is the sensing chain's; what is left with true markers is the
grasp's (markers that slip, a tip that does not quite rest).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tiptrace.evaluation.metrics import evaluate
from tiptrace.pipeline import open_tracer, trace
from tiptrace.sim.disturbances import Disturbances
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.types import Sample, Stream, TruthSample


@dataclass
class Kept:
    """A stream whose samples are kept, so that every method sees the same trial."""

    stream: Stream

    def __post_init__(self) -> None:
        self.rig, self.tool = self.stream.rig, self.stream.tool
        self.references, self.gel_models = self.stream.references, self.stream.gel_models
        self.samples = list(self.stream)

    def __iter__(self) -> Iterator[Sample]:
        return iter(self.samples)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--methods", nargs="+", default=["paper", "full"])
    args = parser.parse_args()
    still = Disturbances(camera_noise=0.0, latency_known=True)
    print("errors in mm      markers from     trajectory   shape   contact   cross-track")
    for trajectory in ("T1", "T3"):
        for mode in ("images", "markers"):
            spec = make_spec(
                trajectory=trajectory, level="clean", mode=mode, seed=args.seed, disturbances=still
            )
            kept = Kept(SimulatedStream(spec))
            truth = [sample for sample in kept.samples if isinstance(sample, TruthSample)]
            for method in args.methods:
                with open_tracer(kept, method) as tracer:
                    m = evaluate(trace(kept, tracer), truth)
                values = (
                    m.trajectory_rmse_mm,
                    m.shape_rmse_mm,
                    m.initial_contact_error_mm,
                    m.cross_track_rmse_mm,
                )
                source = "images" if mode == "images" else "true positions"
                print(
                    f"{trajectory} {method:12s}  {source:15s}"
                    + "".join(f"{v:11.3f}" for v in np.asarray(values))
                )


if __name__ == "__main__":
    main()
