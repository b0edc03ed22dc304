"""A short simulated trial, once per test session."""

from __future__ import annotations

from functools import cache

from tiptrace.config import Rig
from tiptrace.sim.spec import TrialSpec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.types import Image, Sample, Side


@cache
def short_trial(seconds: float = 2.0) -> tuple[Rig, dict[Side, Image], tuple[Sample, ...]]:
    """Rig, references and the first seconds of a trial with images."""
    stream = SimulatedStream(TrialSpec(seed=3))
    samples: list[Sample] = []
    for sample in stream:
        samples.append(sample)
        if (sample.stamp_ns - samples[0].stamp_ns) * 1e-9 > seconds:
            break
    return stream.rig, stream.references, tuple(samples)
