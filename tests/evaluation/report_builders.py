"""Report data with everything in it, made without any other part of the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tiptrace.evaluation.report_data import AnchoringFit, MethodResult, ReportData, TactileView
from tiptrace.evaluation.truth import Truth
from tiptrace.types import Event, FloatArray, Side, Status

from .builders import FRAME_NS, START_NS, trajectory_of

ANCHORING, MOVING = 100, 250


def t3() -> FloatArray:
    x = np.concatenate([np.zeros(ANCHORING), np.linspace(0.0008, 0.2, MOVING)])
    y = 4e-3 * np.sin(2 * np.pi * x / 0.05)
    return np.stack([0.4 + x, -0.1 + y, np.full_like(x, 0.02)], axis=1)


def full_report(seed: int = 0) -> ReportData:
    rng = np.random.default_rng(seed)
    p = t3()
    noise = np.cumsum(rng.standard_normal(p.shape), axis=0) * 5e-5
    converge = np.exp(-np.arange(ANCHORING) / 20.0)[:, None] * [0.03, -0.02, 0.08]
    estimate = p + noise + [1e-3, 5e-4, 2e-3]
    estimate[:ANCHORING] += converge
    covariance = np.diag([0.6, 0.5, 1.1]) ** 2 * 1e-6
    main = trajectory_of(estimate, ANCHORING, estimate[ANCHORING - 1], covariance, loop_ms=18.0)
    main.estimates = [
        replace(e, loop_ms=float(15 + 3 * rng.random() + (150 if k == 0 else 0)))
        for k, e in enumerate(main.estimates)
    ]
    for k in range(200, 212):
        main.estimates[k] = replace(main.estimates[k], status=Status.LOST, p_B=None)
    for k in range(260, 280):
        main.estimates[k] = replace(main.estimates[k], status=Status.DEGRADED)
    main.events = [
        Event("marker-lost", START_NS + 150 * FRAME_NS, START_NS + 160 * FRAME_NS, "left, marker 12"),
        Event("too-few-markers", START_NS + 200 * FRAME_NS, START_NS + 212 * FRAME_NS, "2 of 16 <left>"),
    ]
    line = p.copy()
    line[ANCHORING:, 1] = p[0, 1]
    line[ANCHORING:, 0] += 4e-3
    ee = trajectory_of(line, ANCHORING, line[0])
    stamps = np.array([e.stamp_ns for e in main.estimates], dtype=np.int64)
    return ReportData(
        title="T3, O1, W1, G1",
        methods=(MethodResult("paper", main), MethodResult("ee-only", ee)),
        truth=Truth(stamps, p),
        tactile=(tactile("left", rng), tactile("right", rng)),
        anchoring=AnchoringFit(stamps[:ANCHORING], np.abs(rng.standard_normal(ANCHORING)) * 0.3),
        step_ms={
            name: 1 + rng.random(350) * k for k, name in enumerate(("decode", "tracking", "depth", "fit"), 1)
        },
        settings={"trajectory": "T3", "tool": "O1", "seed": "0"},
        versions={"tiptrace": "0.1.0", "numpy": np.__version__},
        command="tiptrace demo --out demo",
        source="trial.mcap",
    )


def tactile(side: Side, rng: np.random.Generator) -> TactileView:
    v, u = np.mgrid[0:240, 0:320]
    press = np.exp(-(((u - 160) / 50.0) ** 2 + ((v - 120) / 90.0) ** 2))
    image = np.stack([83 + 40 * press, 72 + 60 * press, 70 + 50 * press], axis=-1).astype(np.uint8)
    uv = np.stack(np.meshgrid(np.arange(40, 300, 32.0), np.arange(24, 230, 32.0)), axis=-1).reshape(-1, 2)
    for a, b in uv:
        image[(u - a) ** 2 + (v - b) ** 2 < 25] = 26
    moved = uv + [3.0, -4.0] + rng.standard_normal(uv.shape) * 0.5
    moved[5] = np.nan
    selected = np.zeros(len(uv), dtype=bool)
    selected[rng.choice(len(uv), 8, replace=False)] = True
    depth = 1.1 * press + rng.standard_normal(press.shape) * 0.01
    return TactileView(side, image, image, uv, moved, selected, depth, depth * 0.9)
