"""Everything compiled is made ready before the first frame, which would otherwise wait for it."""

from __future__ import annotations

import functools

import numpy as np

from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.motion import MotionConfig, TemplateFit
from tiptrace.estimation.pattern_kernels import pattern_change
from tiptrace.estimation.pose_track import PoseTrack
from tiptrace.estimation.tip_map import solve_tip_map
from tiptrace.estimation.tip_map_config import TipMapConfig
from tiptrace.types import PoseSample


@functools.cache
def warm_up() -> None:
    """Solve a made-up Stage I: compiles what is not yet on disk, loads the rest. Once."""
    M = np.stack([np.arange(8.0) % 2, np.arange(8.0) // 4, np.arange(8.0) // 2 % 2], axis=1) * 1e-2
    fit = TemplateFit(M, np.repeat([0, 1], 4), np.stack([np.eye(3)] * 2), np.ones(8), MotionConfig())
    residual = fit.residuals(M[None], fit.fit(M[None]))
    fit.twist(residual[0])
    pattern_change(residual, residual)
    track = PoseTrack()
    track.extend(PoseSample(k * 10**7, np.eye(4)) for k in range(8))
    stamps = np.linspace(1e7, 6e7, 6)
    frames = fit.fit(np.repeat(M[None], len(stamps), axis=0))
    solve_tip_map(
        frames,
        lambda _: track.at(stamps),
        np.linspace(-1.0, 0.0, len(stamps)),
        1.0,
        TipMapConfig(),
        prior=TipPrior(np.array([0.0, 0.0, 0.1]), 1e-6 * np.eye(3)),
    )
