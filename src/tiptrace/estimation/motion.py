"""In-grasp motion of the tool: weighted rigid fit of a marker template (``docs/estimation.md``, Motion).

Works in F_E on any number of frames at once. A marker's depth is known worse than its place in the image, and each
pad's depth may tilt slowly: depth residuals are explained by ``a_k u + b_k v`` (k pad) with Gaussian priors that are
marginalised, and by a per-marker bias that enters its variance. The Jacobian is taken at the template, where
in-grasp rotations of a few degrees leave it: it is computed once, and a frame costs two small products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.kernels import fit_frames, residuals_in_plane
from tiptrace.estimation.pattern_kernels import turn_of
from tiptrace.geometry.transforms import skew
from tiptrace.types import FloatArray


class MotionConfig(BaseModel):
    """Noise of a marker and priors of the nuisances."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    in_plane_sigma_m: float = Field(default=4e-5, gt=0)
    depth_sigma_m: float = Field(default=1.5e-4, gt=0)
    depth_bias_sigma_m: float = Field(default=5e-5, ge=0)
    tilt_sigma_rad: float = Field(default=0.02, gt=0)
    huber: float = Field(default=2.5, gt=0)
    iterations: int = Field(default=3, ge=1)
    min_markers: int = Field(default=5, ge=3)


@dataclass(frozen=True, slots=True)
class Motions:
    """Rigid motions ``x ↦ R_t x + t_t`` of the template in F_E.

    Attributes:
        R: (T, 3, 3).
        t: (T, 3) m.
        covariance: (T, 6, 6) of (rotation vector about ``centre`` in rad, translation in m), F_E.
        centre: (T, 3) where the rotation noise acts: the markers' centroid.
        residual_m: (T,) root mean square in-plane residual.
        weights: (T, N) robust weight of each marker in each frame, 0 where it was not seen.
        chi2: (T,) weighted sum of squared whitened residuals over its degrees of freedom.
        sides: (T, 2) sum of weights on the left and right pad.
    """

    R: FloatArray
    t: FloatArray
    covariance: FloatArray
    centre: FloatArray
    residual_m: FloatArray
    weights: FloatArray
    chi2: FloatArray
    sides: FloatArray

    def __len__(self) -> int:
        return len(self.R)


class TemplateFit:
    """Fits frames to one template; building it costs some products, fitting a frame next to nothing."""

    def __init__(
        self,
        M: FloatArray,
        pad: FloatArray,
        axes: FloatArray,
        trust: FloatArray,
        config: MotionConfig,
    ) -> None:
        """Prepare the Jacobian.

        Args:
            M: (N, 3) template in F_E, m.
            pad: (N,) 0 for left, 1 for right.
            axes: (2, 3, 3) rotation of T_E_S of each pad: columns u, v, normal in F_E.
            trust: (N,) weight of each marker in [0, 1].
            config: Noise and priors.
        """
        self._config = config
        self._all = M
        self.pad, self.axes, self.trust = pad, axes, trust  # as given, so that a fit can be made again
        self._active = np.flatnonzero(np.isfinite(M).all(axis=1) & (trust > 0))  # rows in use
        self._M = np.ascontiguousarray(M[self._active])
        self._trust, self._pad = trust[self._active], pad[self._active].astype(int)
        self._g = (
            np.average(self._M, axis=0, weights=self._trust) if len(self._M) else np.zeros(3)
        )  # centroid
        self._basis = axes[self._pad]  # (N, 3, 3): columns u, v, n
        self._sigma = np.array(
            [config.in_plane_sigma_m] * 2 + [np.hypot(config.depth_sigma_m, config.depth_bias_sigma_m)]
        )
        self._whiten = np.ascontiguousarray(
            np.swapaxes(self._basis, 1, 2) / self._sigma[:, None]
        )  # (N, 3, 3): r_E → whitened (u, v, n)
        self._J = self._jacobian()  # (N, 3, 10) whitened
        self._JJ = np.einsum("nij,nik->njk", self._J, self._J).reshape(len(self._M), 100)
        # 1e-6 (σ of 1 krad, 1 km): a frame without markers stays solvable
        self._prior = np.diag([1e-6] * 6 + [config.tilt_sigma_rad**-2] * 4)
        self._normals = np.ascontiguousarray(self._basis[:, :, 2])
        self._normal = self._normals[0] if len(self._M) else np.zeros(3)  # one axis for both pads
        self._rows = [np.flatnonzero(self._pad == k) for k in (0, 1)]
        self._on_pad = np.stack([self._pad == 0, self._pad == 1], axis=1).astype(np.float64)  # (n, 2)

    def _jacobian(self) -> FloatArray:
        """Whitened rows u, v, n against (ω, v, a_left, b_left, a_right, b_right)."""
        N = len(self._M)
        J_E = np.concatenate([-skew(self._M - self._g), np.broadcast_to(np.eye(3), (N, 3, 3))], axis=2)
        J = np.zeros((N, 3, 10))
        J[:, :, :6] = self._whiten @ J_E
        for k in (0, 1):
            here = self._pad == k
            if not here.any():
                continue
            middle = np.average(self._M[here], axis=0, weights=self._trust[here])
            uv = np.einsum("nij,ni->nj", self._basis[here], self._M[here] - middle)[
                :, :2
            ]  # from the patch's centre
            J[here, 2, 6 + 2 * k : 8 + 2 * k] = uv / self._sigma[2]
        return J

    @property
    def template(self) -> FloatArray:
        """(N, 3) in F_E, m."""
        return self._all

    def fit(self, X: FloatArray, start: tuple[FloatArray, FloatArray] | None = None) -> Motions:
        """Motions of T frames.

        Args:
            X: (T, N, 3) markers in F_E, m, NaN where lost.
            start: Initial R (T, 3, 3) and t (T, 3); None: no motion.
        """
        X = np.ascontiguousarray(X[:, self._active])  # (T, n, 3)
        T = len(X)
        R = np.tile(np.eye(3), (T, 1, 1)) if start is None else np.array(start[0])
        t = np.zeros((T, 3)) if start is None else np.array(start[1])
        c = self._config
        covariance, weights, squares = fit_frames(
            X,
            R,
            t,
            self._M,
            self._whiten,
            self._J,
            self._JJ,
            self._prior,
            self._trust,
            self._g,
            c.huber,
            c.iterations,
        )
        base = np.where(weights > 0, self._trust, 0.0)
        sides = base @ self._on_pad  # (T, 2)
        total = np.maximum(base.sum(axis=1), 1e-9)
        return Motions(
            R=R,
            t=t,
            covariance=covariance,  # nuisances marginalised
            centre=R @ self._g + t,
            residual_m=np.sqrt(squares[:, 0] / total) * self._sigma[0],
            weights=self._scatter(weights),
            chi2=squares[:, 1] / np.maximum(3.0 * total - 6.0, 1.0),
            sides=sides,
        )

    def _scatter(self, values: FloatArray) -> FloatArray:
        """(T, active) → (T, N), 0 elsewhere."""
        full = np.zeros((len(values), len(self._all)))
        full[:, self._active] = values
        return full

    def residuals(self, X: FloatArray, motions: Motions) -> FloatArray:
        """In-plane residuals in F_E, (T, N, 3) m; NaN where lost or not in use.

        Args:
            X: (T, N, 3) markers in F_E.
            motions: Fitted to them.
        """
        out = np.full(X.shape, np.nan)
        seen = np.ascontiguousarray(X[:, self._active])
        out[:, self._active] = residuals_in_plane(seen, motions.R, motions.t, self._M, self._normals)
        return out

    def twist(self, residual_E: FloatArray) -> float:
        """Rotation about the closing axis by which the left pad's markers lead the right's, (N, 3) m → rad."""
        r = residual_E[self._active]
        left, right = (turn_of(r, self._M, rows, self._normal) for rows in self._rows)
        return left - right

    def refined_template(self, X: FloatArray, motions: Motions) -> FloatArray:
        """Mean of the frames carried back to the template, (N, 3); markers never seen stay."""
        back = np.einsum("tji,tnj->tni", motions.R, np.where(np.isfinite(X), X, 0.0) - motions.t[:, None])
        seen = motions.weights + 1e-9 * np.isfinite(X[..., 0])
        total = seen.sum(axis=0)  # (N,)
        mean = np.einsum("tn,tni->ni", seen, back) / np.maximum(total, 1e-12)[:, None]
        return np.asarray(np.where(total[:, None] > 0, mean, self._all))
