"""Marker-level trials of the virtual rig for the estimation benchmarks, kept on disk once simulated."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.evaluation.truth import Truth
from tiptrace.sim.conditions import CONDITIONS
from tiptrace.sim.seeds import stream
from tiptrace.sim.simulation import Frame
from tiptrace.sim.spec import TrialSpec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.synchronise import synchronise
from tiptrace.types import FingerMarkers, Observation, SensedFinger, SensedPair, TruthSample


@dataclass(frozen=True, slots=True)
class Trial:
    """What an estimator sees, and the truth."""

    spec: TrialSpec
    rig: Rig
    tool: Tool | None
    pairs: list[SensedPair]
    truth: Truth
    in_contact: np.ndarray
    exposure_ns: np.ndarray
    slip_deg: np.ndarray
    slip_m: np.ndarray

    @property
    def nominal_error_m(self) -> np.ndarray:
        """(3,) error of the tip that the tool's file states, in F_E."""
        sigma = self.spec.disturbed_by.nominal_tip_m
        return np.asarray(sigma * stream(self.spec.seed, "nominal-tip").normal(size=3))


@dataclass
class _Log:
    truth: list[TruthSample] = field(default_factory=list)
    rows: list[tuple[bool, float, float, float]] = field(default_factory=list)

    def __call__(self, frame: Frame) -> None:
        s = frame.state
        self.truth += [x for x in frame.samples if isinstance(x, TruthSample)]
        self.rows.append((s.in_contact, s.t_s, s.slip_deg, s.slip_m))


def sensed(observation: Observation, rig: Rig) -> SensedPair:
    fingers = {}
    for side in ("left", "right"):
        o = observation.finger(side)
        x = o.sample.x_S
        fingers[side] = SensedFinger(
            FingerMarkers(x, np.isfinite(x).all(axis=1)), o.T_B_E, rig.T_E_S(side, observation.opening_m)
        )
    return SensedPair(
        observation.stamp_ns, observation.phase, fingers["left"], fingers["right"], observation.poses
    )


def simulate(spec: TrialSpec) -> Trial:
    log = _Log()
    stream = SimulatedStream(spec, log)
    pairs = [sensed(o, stream.rig) for o in synchronise(stream)]
    contact, _, deg, m = (np.array(column) for column in zip(*log.rows, strict=True))
    exposure = np.array([s.stamp_ns for s in log.truth])
    return Trial(
        spec, stream.rig, stream.tool, pairs, Truth.from_samples(log.truth), contact, exposure, deg, m
    )


def trial(spec: TrialSpec, cache: Path | None, simulate_missing: bool = True) -> Trial | None:
    """From the cache, else simulated; None where it is neither."""
    if cache is None:
        return simulate(spec)
    d = spec.disturbances is not None or spec.lifts or spec.pushes or spec.friction_drops or spec.dwells
    if d:
        return simulate(spec)
    name = f"{spec.name}-{spec.level}-{spec.anchor_motion}-{spec.seed}-{spec.anchoring_s:g}-{spec.travel_m:g}.pkl"
    path = cache / name
    if path.exists():
        return pickle.loads(path.read_bytes())  # our own file
    if not simulate_missing:
        return None
    result = simulate(spec)
    cache.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".part").write_bytes(pickle.dumps(result))
    path.with_suffix(".part").rename(path)
    return result


def specs(level: str, anchor_motion: str, seeds: Iterable[int]) -> Iterator[TrialSpec]:
    """The twelve conditions in turn, one per seed."""
    for seed in seeds:
        c = CONDITIONS[seed % len(CONDITIONS)]
        yield TrialSpec(
            trajectory=c.trajectory,
            tool=c.tool,
            wrist=c.wrist,
            grasp=c.grasp,
            level=level,
            anchor_motion=anchor_motion,
            mode="markers",
            seed=seed,
        )
