"""What residuals of the rigid fit have in common, as compiled loops (``motion.py``, ``slip_detector.py``)."""

from __future__ import annotations

import numpy as np

from tiptrace.compiled import compiled
from tiptrace.types import FloatArray, IntArray


@compiled
def turn_of(r: FloatArray, M: FloatArray, rows: IntArray, normal: FloatArray) -> float:
    """Rotation about an axis that some markers' residuals have in common, rad; 0 with fewer than three of them.

    Args:
        r: (n, 3) residuals of a frame, NaN where lost.
        M: (n, 3) template.
        rows: Which markers.
        normal: (3,) axis.
    """
    seen = [i for i in rows if np.isfinite(r[i, 0])]
    if len(seen) < 3:
        return 0.0
    x_0, r_0 = np.zeros(3), np.zeros(3)
    for i in seen:
        x_0 += M[i] / len(seen)
        r_0 += r[i] / len(seen)
    moment = square = 0.0
    for i in seen:
        x = M[i] - x_0
        for j in range(3):
            a, b = (j + 1) % 3, (j + 2) % 3
            around = normal[a] * x[b] - normal[b] * x[a]
            moment += around * (r[i, j] - r_0[j])
            square += around * around
    return moment / max(square, 1e-12)


@compiled
def pattern_change(before: FloatArray, after: FloatArray) -> float:
    """Root mean square over markers of the change of their mean residual, (n, N, 3), (m, N, 3) m → m."""
    total, count = 0.0, 0
    for i in range(before.shape[1]):
        n = m = 0
        old, new = np.zeros(3), np.zeros(3)
        for k in range(len(before)):
            if np.isfinite(before[k, i, 0]):
                old += before[k, i]
                n += 1
        for k in range(len(after)):
            if np.isfinite(after[k, i, 0]):
                new += after[k, i]
                m += 1
        if n > 0 and m > 0:
            for j in range(3):
                total += (new[j] / m - old[j] / n) ** 2
            count += 1
    return float(np.sqrt(total / max(count, 1)))
