"""Unknowns of the tip map, their priors and gates (``docs/estimation.md``, Tip map)."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.types import FloatArray

C, P, G_, TAU, DRIFT = slice(0, 3), slice(3, 6), slice(6, 15), slice(15, 16), slice(16, 19)
SIZE = 19
I9 = np.eye(3).ravel()
DIAGONAL = I9 > 0


class TipMapConfig(BaseModel):
    """Priors and gates."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    learn_map: bool = True
    map_sigma: float = Field(default=0.10, gt=0)
    map_off_diagonal_sigma: float = Field(default=0.06, gt=0)
    map_shear_correlation: float = Field(default=0.8, ge=0, lt=1)  # of the two axes along the pads
    map_gate_m: float = Field(default=1e-3, gt=0)  # standard deviation of the enforced motion along an axis
    latency_s: float = 0.050  # where the rig says nothing
    latency_std_s: float = Field(default=0.030, gt=0)
    latency_gate_s: float = Field(default=0.010, gt=0)
    drift_sigma_m: float = Field(default=3e-3, gt=0)  # along the pads
    drift_normal_sigma_m: float = Field(default=1e-4, gt=0)  # across them, where the tool cannot slip
    step_normal_sigma_m: float = Field(
        default=3e-4, gt=0
    )  # of a slip across the pads: depth is another afterwards
    hidden_drift: float = Field(default=0.3, ge=0)  # share of its σ that a drift without evidence still has
    slip_again: float = Field(default=0.5, ge=0)  # of the slips in Stage I, per its length, in Stage II
    drift_evidence: float = Field(default=3.0, gt=0)  # sigmas
    pose_sigma_m: float = Field(default=4e-5, gt=0)  # of the tip through the smoothed hand pose
    model_sigma_m: float = Field(default=1e-4, gt=0)  # what a linear map leaves, per frame
    common_sigma_m: float = Field(default=8e-5, ge=0)  # and what it leaves in all frames alike, per axis
    # frames' variance is measured in Stage I, but slow errors do not show there: never below this share of the assumed
    least_noise: float = Field(default=0.25, gt=0)
    outlier: float = Field(default=6.0, gt=0)  # whitened residual of a frame in which the tip did not rest
    iterations: int = Field(default=15, ge=3)


def map_prior(config: TipMapConfig, normal: FloatArray) -> FloatArray:
    """Covariance (9, 9) of G, row-major: what the gel shows along the two axes in the pads' plane is alike."""
    basis = np.linalg.svd(normal[None])[2]  # rows: normal, two axes along the pads
    sigma = np.where(np.eye(3) > 0, config.map_sigma, config.map_off_diagonal_sigma).ravel()
    P = np.diag(sigma**2)
    P[4, 8] = P[8, 4] = config.map_shear_correlation * config.map_sigma**2
    turn = np.kron(basis.T, basis.T)  # G_E = basisᵀ G_pad basis
    return np.asarray(turn @ P @ turn.T)
