"""What the hand does: Stage I about the nominal tip, Stage II straight along +x, stops and excursions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tiptrace.geometry.transforms import rotation_exp
from tiptrace.sim.spec import AnchorMotionName, TrialSpec
from tiptrace.types import FloatArray, Phase

_RAMP_S = 0.3  # start and end of the anchoring motion
UNLOAD_S = 0.5  # end of Stage I: the hand, still again, rises to the contact force of the travel


@dataclass(frozen=True, slots=True)
class AnchorMotion:
    """Rotation and translation of the hand in Stage I as harmonics of its duration.

    Attributes:
        rotation_deg: Amplitudes about base x and y.
        translation_m: Amplitudes along base x and y.
        about_tip: About the nominal tip, else about the pads.
        cycles: Cycles of (rotation x, rotation y, translation x, translation y) in Stage I.
    """

    rotation_deg: tuple[float, float]
    translation_m: tuple[float, float] = (0.0, 0.0)
    about_tip: bool = True
    cycles: tuple[int, int, int, int] = (2, 1, 3, 4)

    def at(self, tau: float) -> tuple[FloatArray, FloatArray]:
        """Rotation vector (3,) rad and translation (3,) m at the fraction tau of the motion; zero at both ends."""
        wave = np.sin(2.0 * np.pi * tau * np.array(self.cycles))  # (4,)
        w = np.radians(np.array([*self.rotation_deg, 0.0])) * np.array([wave[0], wave[1], 0.0])
        d = np.array([self.translation_m[0] * wave[2], self.translation_m[1] * wave[3], 0.0])
        return w, d


ANCHOR_MOTIONS: dict[AnchorMotionName, AnchorMotion] = {
    "recommended": AnchorMotion((10.0, 10.0), (4e-3, 4e-3)),
    "two-axis": AnchorMotion((5.0, 5.0)),
    "one-axis": AnchorMotion((0.0, 5.0)),
    "pads": AnchorMotion((5.0, 5.0), about_tip=False),
}


def travelled(t: float, duration: float, ramp: float) -> float:
    """Fraction of the way at time t of a motion with constant speed between two ramps."""
    if duration <= 0.0:
        return 1.0 if t >= 0.0 else 0.0
    ramp = min(ramp, 0.5 * duration)
    t = min(max(t, 0.0), duration)
    speed = 1.0 / (duration - ramp)
    if ramp > 0.0 and t < ramp:
        return 0.5 * speed * t * t / ramp
    if ramp > 0.0 and t > duration - ramp:
        rest = duration - t
        return 1.0 - 0.5 * speed * rest * rest / ramp
    return speed * (t - 0.5 * ramp)


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of the protocol.

    Attributes:
        start_s: When it starts.
        duration_s: How long it takes.
        from_m: Hand travel at its start.
        to_m: And at its end.
        anchoring: Whether the hand makes its anchoring motion.
        rest_s: How long it rests at the end.
    """

    start_s: float
    duration_s: float
    from_m: float
    to_m: float
    anchoring: bool = False
    rest_s: float = 0.0

    @property
    def end_s(self) -> float:
        """When it ends."""
        return self.start_s + self.duration_s


def plan(spec: TrialSpec) -> tuple[Segment, ...]:
    """Stage I, then travel with its stops."""
    segments: list[Segment] = []
    now = travel = 0.0

    def add(duration: float, to: float, anchoring: bool = False) -> None:
        nonlocal now, travel
        rest = min(UNLOAD_S, 0.25 * duration) if anchoring else 0.0
        segments.append(Segment(now, duration, travel, to, anchoring, rest))
        now, travel = now + duration, to

    if spec.anchoring_s > 0.0:
        add(spec.anchoring_s, 0.0, anchoring=True)
    for dwell in sorted(spec.dwells, key=lambda d: d.at_m):
        stop = min(dwell.at_m, spec.travel_m)
        if stop > travel:
            add((stop - travel) / spec.speed_mps + spec.ramp_s, stop)
        add(dwell.duration_s, stop, dwell.anchoring)
    if spec.travel_m > travel:
        add((spec.travel_m - travel) / spec.speed_mps + spec.ramp_s, spec.travel_m)
    return tuple(segments)


def smooth_pulse(t: float, start: float, duration: float) -> float:
    """0 → 1 → 0 with level tangents, flat in its middle half."""
    u = (t - start) / duration
    if not 0.0 < u < 1.0:
        return 0.0
    rise = min(4.0 * u, 4.0 * (1.0 - u), 1.0)
    return float(0.5 - 0.5 * np.cos(np.pi * rise))


@dataclass(frozen=True, slots=True)
class Hand:
    """The commanded pose of the end effector over time.

    Attributes:
        spec: The trial.
        segments: Its plan.
        T_B_E_start: (4, 4) pose after pressing down.
        nominal_tip_E: (3,) tip that the hand believes in.
        pads_E: (3,) centre of the pads.
    """

    spec: TrialSpec
    segments: tuple[Segment, ...]
    T_B_E_start: FloatArray
    nominal_tip_E: FloatArray
    pads_E: FloatArray

    @property
    def duration_s(self) -> float:
        """Length of the trial."""
        return self.segments[-1].end_s if self.segments else 0.0

    @property
    def anchoring_end_s(self) -> float:
        """End of Stage I."""
        return self.spec.anchoring_s

    def segment(self, t: float) -> Segment:
        """The piece that the time t belongs to."""
        for segment in self.segments:
            if t < segment.end_s:
                return segment
        return self.segments[-1]

    def phase(self, t: float) -> Phase:
        """Segment of the trial in the paper's sense."""
        return Phase.ANCHORING if t < self.anchoring_end_s else Phase.RECONSTRUCTION

    def pose(self, t: float) -> FloatArray:
        """T_B_E (4, 4) at time t, without the guard's correction."""
        s = self.segment(t)
        ramp = _RAMP_S if s.anchoring else self.spec.ramp_s
        fraction = travelled(t - s.start_s, s.duration_s - s.rest_s, ramp)
        T = self.T_B_E_start.copy()
        if s.anchoring:
            motion = ANCHOR_MOTIONS[
                self.spec.anchor_motion if s.start_s == 0.0 else "two-axis"
            ]  # no pit there
            w, d = motion.at(fraction)
            pivot_E = self.nominal_tip_E if motion.about_tip else self.pads_E
            pivot_B = T[:3, :3] @ pivot_E + T[:3, 3]
            R = rotation_exp(w)
            T[:3, 3] = pivot_B + R @ (T[:3, 3] - pivot_B) + d
            T[:3, :3] = R @ T[:3, :3]
        T[0, 3] += s.from_m + (s.to_m - s.from_m) * (1.0 if s.anchoring else fraction)
        T[2, 3] += sum(
            (lift.height_m * smooth_pulse(t, lift.start_s, lift.duration_s) for lift in self.spec.lifts), 0.0
        )
        return T


def pad_friction(spec: TrialSpec, friction: float) -> Callable[[float], float]:
    """Pad friction coefficient over time."""

    def at(t: float) -> float:
        mu = friction
        for drop in spec.friction_drops:
            mu *= 1.0 - (1.0 - drop.factor) * smooth_pulse(t, drop.start_s, drop.duration_s)
        return mu

    return at


def tip_push(spec: TrialSpec, t: float) -> FloatArray:
    """(3,) extra force on the tip at time t, N."""
    push = np.zeros(3)
    for p in spec.pushes:
        push += np.array(p.force_n) * smooth_pulse(t, p.start_s, p.duration_s)
    return push
