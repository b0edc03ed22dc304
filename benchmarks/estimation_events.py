"""How surely events are told: slips of the tool, losses of contact, false alarms, and re-anchoring.

    python benchmarks/estimation_events.py --seeds 1100:1131 --kinds lift,slip,reanchor --cache build/trials
    python benchmarks/estimation_events.py --seeds 1100:1124 --kinds recommended,two-axis --cache build/trials

Marker-level trials of the virtual rig. A true slip is 1.5° or 0.5 mm of the tool against the pads within half a
second; a true loss of contact lasts longer than 0.2 s. A slip counts as found when it is told within 1 s of its end,
a loss when it is told within 0.3 s of its end, by an event that reaches into it. Both kinds are scored in trials with
lifts and in trials with slips. Told where there was not even a third of a true slip, or no loss at all, it is false.
In undisturbed trials (recommended, two-axis) all events are false.
"""

from __future__ import annotations

import argparse
import pickle
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from estimation_trials import Trial, simulate, specs
from estimation_trials import trial as plain_trial

from tiptrace.errors import SimulationError
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.full_config import FullConfig
from tiptrace.sim.conditions import CONDITIONS
from tiptrace.sim.spec import Dwell, FrictionDrop, Lift, Push, TrialSpec
from tiptrace.types import Event, Phase, TipEstimate

SLIP_DEG, SLIP_M, SLIP_WINDOW_S = 1.5, 0.5e-3, 0.5
LOSS_S, TOLD_LOSS_S, TOLD_SLIP_S = 0.2, 0.3, 1.0
_FPS = 25.0


@dataclass
class Score:
    """Counts over trials."""

    true: int = 0
    found: int = 0
    false: Counter[str] = field(default_factory=Counter)
    minutes: float = 0.0
    delays_s: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)


def spec(kind: str, seed: int, level: str) -> TrialSpec:
    """A trial with three disturbances of one kind at random times, of random size."""
    rng = np.random.default_rng([seed, len(kind)])
    c = CONDITIONS[seed % len(CONDITIONS)]
    starts = 5.0 + 2.2 * np.arange(3) + rng.uniform(0.0, 0.8, 3)
    extra: dict[str, object] = {}
    if kind == "lift":
        extra["lifts"] = tuple(
            Lift(
                start_s=float(s),
                duration_s=float(rng.uniform(0.4, 1.4)),
                height_m=float(rng.uniform(4e-3, 8e-3)),
            )
            for s in starts
        )
    if kind == "slip":
        starts = 5.2 + 2.6 * np.arange(2) + rng.uniform(0.0, 1.0, 2)
        factors, sides = rng.uniform(0.02, 0.10, 2), rng.choice([-1.0, 1.0], 2) * rng.uniform(1.0, 4.0, 2)
        extra["friction_drops"] = tuple(
            FrictionDrop(start_s=float(s), duration_s=0.5, factor=float(f))
            for s, f in zip(starts, factors, strict=True)
        )
        extra["pushes"] = tuple(
            Push(start_s=float(s), duration_s=0.5, force_n=(0.0, float(f), 0.0))
            for s, f in zip(starts, sides, strict=True)
        )
    if kind == "reanchor":  # a slip on the first 40 mm, then a stop with an anchoring motion
        s = float(rng.uniform(4.9, 5.5))
        extra["friction_drops"] = (
            FrictionDrop(start_s=s, duration_s=0.5, factor=float(rng.uniform(0.03, 0.1))),
        )
        extra["pushes"] = (Push(start_s=s, duration_s=0.5, force_n=(0.0, float(rng.uniform(1.0, 3.0)), 0.0)),)
        extra["dwells"] = (Dwell(at_m=0.04, duration_s=5.0, anchoring=True),)
    return TrialSpec(
        trajectory=c.trajectory,
        tool=c.tool,
        wrist=c.wrist,
        grasp=c.grasp,
        level=level,
        mode="markers",
        seed=seed,
        travel_m={"lift": 0.14, "slip": 0.12, "reanchor": 0.08}[kind],
        **extra,
    )


def trial(kind: str, seed: int, level: str, cache: Path | None) -> Trial:
    """Simulated, or from the cache."""
    path = None if cache is None else cache / f"{kind}-{level}-{seed}.pkl"
    if path is not None and path.exists():
        return pickle.loads(path.read_bytes())  # our own file
    result = simulate(spec(kind, seed, level))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(result))
    return result


def true_losses(t: Trial) -> list[tuple[int, int]]:
    """Exposure intervals without contact, ns."""
    free = np.concatenate([[False], ~t.in_contact, [False]])
    edges = np.flatnonzero(np.diff(free.astype(int)))
    spans = [(int(t.exposure_ns[a]), int(t.exposure_ns[b - 1])) for a, b in edges.reshape(-1, 2)]
    return [(a, b) for a, b in spans if (b - a) * 1e-9 + 1.0 / _FPS > LOSS_S]


def true_slips(t: Trial, share: float = 1.0) -> list[tuple[int, int]]:
    """Intervals in which the tool moved in the pads by more than a share of the limit within half a second, ns."""
    n = round(SLIP_WINDOW_S * _FPS)
    turn, shift = np.abs(t.slip_deg[n:] - t.slip_deg[:-n]), t.slip_m[n:] - t.slip_m[:-n]
    much = np.concatenate([[False], (turn > share * SLIP_DEG) | (shift > share * SLIP_M), [False]])
    edges = np.flatnonzero(np.diff(much.astype(int)))
    return [
        (int(t.exposure_ns[a]), int(t.exposure_ns[min(b - 1 + n, len(t.exposure_ns) - 1)]))
        for a, b in edges.reshape(-1, 2)
    ]


def run(t: Trial) -> tuple[list[TipEstimate], list[tuple[Event, int]]]:
    """Estimates, and the events with the instant (exposure, ns) at which each was first told."""
    estimator = FullEstimator(FullConfig(use_tip_prior=False), t.rig, t.tool)
    estimates: list[TipEstimate] = []
    told: list[int] = []
    for pair in t.pairs:
        estimates.append(estimator.update(pair))
        told += [estimates[-1].stamp_ns] * (len(estimator.events) - len(told))
    return estimates, list(zip(estimator.events, told, strict=True))


def match(
    score: Score,
    name: str,
    spans: list[tuple[int, int]],
    doubtful: list[tuple[int, int]],
    events: list[tuple[Event, int]],
    kind: str,
    within_s: float,
) -> None:
    """Which true intervals were told in time; what is left over is false."""
    slack = round(within_s * 1e9)
    used: set[int] = set()
    for a, b in spans:
        hits = [
            k
            for k, (e, told) in enumerate(events)
            if e.kind == kind and told <= b + slack and e.end_ns >= a - round(5e7) and e.start_ns <= b + slack
        ]
        late = [
            k
            for k, (e, _) in enumerate(events)
            if e.kind == kind and e.start_ns <= b + 10**9 and e.end_ns >= a - 10**9
        ]
        used.update(hits, late)
        score.true += 1
        score.found += bool(hits)
        if hits:
            score.delays_s.append((events[hits[0]][1] - a) * 1e-9)
        else:
            score.missed.append(
                f"{name} {(a - int(1.7672256e18)) * 1e-9:.2f}-{(b - int(1.7672256e18)) * 1e-9:.2f}"
            )
    used |= {
        k
        for k, (e, _) in enumerate(events)
        for a, b in doubtful
        if e.start_ns <= b + 10**9 and e.end_ns >= a - 10**9
    }
    score.false.update(e.kind for k, (e, _) in enumerate(events) if k not in used and e.kind == kind)


def reanchoring(seeds: range, level: str, cache: Path | None, cached_only: bool) -> None:
    """Error before and after the system anchors anew."""
    for seed in seeds:
        if cached_only and cache is not None and not (cache / f"reanchor-{level}-{seed}.pkl").exists():
            continue
        try:
            t = trial("reanchor", seed, level, cache)
        except SimulationError as error:
            print(f"not simulated: reanchor {seed}: {error}", flush=True)
            continue
        estimates, events = run(t)
        at = [told for e, told in events if e.kind == "re-anchored"]
        rows = [e for e in estimates if e.p_B is not None and e.phase is Phase.RECONSTRUCTION]
        stamps = np.array([e.stamp_ns for e in rows])
        error = np.linalg.norm(np.stack([e.p_B for e in rows]) - t.truth.at(stamps), axis=1) * 1e3
        if not at:
            print(
                f"{t.spec.name} {seed}: not anchored anew; error at the end {error[-30:-5].mean():.2f} mm",
                flush=True,
            )
            continue
        before, after = error[(stamps < at[0]) & (stamps > at[0] - 10**9)], error[stamps > at[-1] + 2 * 10**8]
        print(
            f"{t.spec.name} {seed}: {len(at)} times anew, error {np.nanmean(before):.2f} mm before, "
            f"{np.nanmean(after):.2f} mm after",
            flush=True,
        )


KINDS = {"contact-lost": (TOLD_LOSS_S, true_losses), "grasp-slip": (TOLD_SLIP_S, true_slips)}


def disturbed(kind: str, seeds: range, level: str, cache: Path | None, cached_only: bool) -> dict[str, Score]:
    """Losses and slips alike, whichever of the two a trial was made for: one may pass for the other."""
    scores = {event: Score() for event in KINDS}
    for seed in seeds:
        if cached_only and cache is not None and not (cache / f"{kind}-{level}-{seed}.pkl").exists():
            continue
        try:
            t = trial(kind, seed, level, cache)
        except SimulationError as error:
            print(f"not simulated: {kind} {seed}: {error}", flush=True)
            continue
        tally(scores, t, f"{t.spec.name} {seed}")
    return scores


def undisturbed(motion: str, seeds: range, level: str, cache: Path | None, cached_only: bool) -> None:
    """What is told of trials in which nothing happens, by kind."""
    found: Counter[str] = Counter()
    minutes, where = 0.0, []
    for s in specs(level, motion, seeds):
        try:
            t = plain_trial(s, cache, not cached_only)
        except SimulationError as error:
            print(f"not simulated: {s.name} {s.seed}: {error}", flush=True)
            continue
        if t is None:
            continue
        _, events = run(t)
        kinds = [e.kind for e, _ in events]
        found.update(kinds)
        where += [f"{s.name} {s.seed}: {', '.join(kinds)}"] if kinds else []
        minutes += duration_min(t)
    print(
        f"undisturbed, {level}, {motion}: {dict(found)} in {minutes:.1f} minutes; {'; '.join(where) or 'none'}",
        flush=True,
    )


def duration_min(t: Trial) -> float:
    return (t.pairs[-1].stamp_ns - t.pairs[0].stamp_ns) / 6e10


def tally(scores: dict[str, Score], t: Trial, name: str) -> None:
    """Add a trial's events to the scores."""
    _, events = run(t)
    for event, (within, truth) in KINDS.items():
        free = np.flatnonzero(np.diff(np.concatenate([[False], ~t.in_contact, [False]]).astype(int)))
        short = [(int(t.exposure_ns[a]), int(t.exposure_ns[b - 1])) for a, b in free.reshape(-1, 2)]
        doubtful = short if event == "contact-lost" else true_slips(t, 1.0 / 3.0)
        match(scores[event], name, truth(t), doubtful, events, event, within)
        scores[event].minutes += duration_min(t)


def show(kind: str, scores: dict[str, Score]) -> None:
    for event, score in scores.items():
        delay = f"{np.median(score.delays_s):.2f} s (median after the start)" if score.delays_s else "-"
        share = f" ({100 * score.found / score.true:.1f} %)" if score.true else ""
        print(
            f"{kind}: {score.found} of {score.true} {event} told in time{share}, {delay}; "
            f"false {dict(score.false)} in {score.minutes:.1f} minutes; missed: {'; '.join(score.missed) or 'none'}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="1100:1131")
    parser.add_argument("--kinds", default="lift,slip", help="of lift, slip, reanchor, recommended, two-axis")
    parser.add_argument("--level", default="nominal")
    parser.add_argument("--cache", type=Path, help="folder that keeps simulated trials")
    parser.add_argument("--cached-only", action="store_true")
    args = parser.parse_args()
    seeds = range(*map(int, args.seeds.split(":")))
    for kind in args.kinds.split(","):
        if kind == "reanchor":
            reanchoring(seeds, args.level, args.cache, args.cached_only)
        elif kind in ("recommended", "two-axis"):
            undisturbed(kind, seeds, args.level, args.cache, args.cached_only)
        else:
            show(kind, disturbed(kind, seeds, args.level, args.cache, args.cached_only))


if __name__ == "__main__":
    main()
