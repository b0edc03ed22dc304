"""Distance to a path and progress along it, for paths given as points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.types import FloatArray

DEFAULT_SPACING_M = 0.5e-3
_CHUNK = 2_000_000  # point-segment pairs handled at once: bounds memory on long trials


@dataclass(frozen=True, slots=True)
class Polyline:
    """A path through space by arc length.

    Attributes:
        vertices: (n, 3) m, no two neighbours alike.
        arc_m: (n,) arc length at each vertex.
    """

    vertices: FloatArray
    arc_m: FloatArray

    @classmethod
    def through(cls, points: ArrayLike, spacing_m: float = DEFAULT_SPACING_M) -> Self:
        """Path through points, thinned so that neighbours are at least ``spacing_m`` apart.

        Thinning keeps the noise of a measured truth, and time spent at rest, from lengthening the path.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        vertices = points[thin(points, spacing_m)]
        steps = np.linalg.norm(np.diff(vertices, axis=0), axis=1)  # (n-1,)
        return cls(
            vertices=vertices, arc_m=np.concatenate([np.zeros(min(1, len(vertices))), np.cumsum(steps)])
        )

    @property
    def length_m(self) -> float:
        """Total arc length."""
        return float(self.arc_m[-1]) if len(self.arc_m) else 0.0

    def project(
        self, p: ArrayLike, near_arc_m: ArrayLike | None = None, window_m: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Closest points of the path, which continues straight beyond both ends.

        Args:
            p: (m, 3) points, m.
            near_arc_m: (m,) search only segments about this arc length …
            window_m: (m,) … no farther away along the path than this, so that a path that comes back
                on itself is not matched with the wrong pass.

        Returns:
            Distances (m,) and arc lengths of the closest points (m,); below 0 or above the length beyond the
            ends. A path of fewer than two vertices has no direction: arc lengths are then NaN.
        """
        p = np.asarray(p, dtype=np.float64).reshape(-1, 3)
        if len(self.vertices) < 2:
            to_point = p - self.vertices[0] if len(self.vertices) else np.full_like(p, np.nan)
            return np.linalg.norm(to_point, axis=1), np.full(len(p), np.nan)
        near = np.zeros(len(p)) if near_arc_m is None else np.asarray(near_arc_m, dtype=np.float64)
        window = np.full(len(p), np.inf) if window_m is None else np.asarray(window_m, dtype=np.float64)
        step = max(1, _CHUNK // len(self.vertices))
        parts = [
            self._project(p[k : k + step], near[k : k + step], window[k : k + step])
            for k in range(0, len(p), step)
        ]
        distances = [d for d, _ in parts]
        arcs = [s for _, s in parts]
        return np.concatenate([np.zeros(0), *distances]), np.concatenate([np.zeros(0), *arcs])

    def _project(self, p: FloatArray, near: FloatArray, window: FloatArray) -> tuple[FloatArray, FloatArray]:
        a, b = self.vertices[:-1], self.vertices[1:]  # (n-1, 3)
        length = np.diff(self.arc_m)  # (n-1,)
        along = (b - a) / length[:, None]  # unit tangents (n-1, 3)
        s = p @ along.T - np.sum(a * along, axis=1)  # (m, n-1) m along each segment
        low, high = np.zeros_like(length), length.copy()
        low[0], high[-1] = -np.inf, np.inf
        s = np.clip(s, low, high)
        # ‖p − a − s t‖², without building (m, n-1, 3)
        offset2 = np.sum(p * p, axis=1)[:, None] - 2 * p @ a.T + np.sum(a * a, axis=1)  # ‖p − a‖²
        d2 = offset2 - 2 * s * (p @ along.T - np.sum(a * along, axis=1)) + s * s
        arc = self.arc_m[:-1] + s  # (m, n-1)
        outside = np.abs(arc - near[:, None]) > window[:, None]
        outside[outside.all(axis=1)] = False
        best = np.argmin(np.where(outside, np.inf, d2), axis=1)
        rows = np.arange(len(p))
        foot = a[best] + s[rows, best][:, None] * along[best]
        return np.linalg.norm(p - foot, axis=1), np.asarray(arc[rows, best])


def thin(points: FloatArray, spacing_m: float = DEFAULT_SPACING_M) -> list[int]:
    """Indices of the points (n, 3) to keep so that no neighbours are alike or closer than ``spacing_m``."""
    keep: list[int] = []
    for k, point in enumerate(points):
        step = float(np.linalg.norm(point - points[keep[-1]])) if keep else np.inf
        if step >= spacing_m and step > 0:
            keep.append(k)
    return keep


def discrete_frechet(a: ArrayLike, b: ArrayLike) -> float:
    """Discrete Fréchet distance of two point sequences (n, 3) and (m, 3), m (Eiter and Mannila 1994).

    Runs over anti-diagonals of the coupling table, so that memory stays linear. NaN for an empty sequence.
    """
    a, b = np.asarray(a, dtype=np.float64).reshape(-1, 3), np.asarray(b, dtype=np.float64).reshape(-1, 3)
    n, m = len(a), len(b)
    if n == 0 or m == 0:
        return float("nan")
    before = np.full(n + 1, np.inf)  # coupling on the diagonal k − 2, indexed by i + 1
    last = np.full(n + 1, np.inf)  # … and on k − 1
    for k in range(n + m - 1):
        i = np.arange(max(0, k - m + 1), min(n, k + 1))
        d = np.linalg.norm(a[i] - b[k - i], axis=1)
        reach = np.minimum(np.minimum(last[i], last[i + 1]), before[i])
        current = np.full(n + 1, np.inf)
        current[i + 1] = d if k == 0 else np.maximum(d, reach)
        before, last = last, current
    return float(last[n])
