"""From image positions and depth to 3-D markers in F_S (paper, Sec. II-B, output representation)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.errors import PerceptionError
from tiptrace.types import FloatArray


def sample_map(values: NDArray[np.float32], uv_px: FloatArray, step: int = 1) -> FloatArray:
    """Bilinear samples of a map (H', W') at image positions (n, 2) px; NaN where the position is NaN.

    ``step``: the map has one value for each block of step × step image pixels, at the block's centre.
    """
    return _sample(np.ascontiguousarray(values), np.ascontiguousarray(uv_px, dtype=np.float64), step)


@compiled
def _sample(values: NDArray[np.float32], uv_px: FloatArray, step: int) -> FloatArray:
    H, W = values.shape
    samples = np.full(len(uv_px), np.nan)
    for i in range(len(uv_px)):
        if np.isnan(uv_px[i, 0] + uv_px[i, 1]):
            continue
        u = min(max((uv_px[i, 0] - (step - 1) / 2) / step, 0.0), W - 1.0)
        v = min(max((uv_px[i, 1] - (step - 1) / 2) / step, 0.0), H - 1.0)
        u0, v0 = min(int(u), W - 2), min(int(v), H - 2)
        a, b = u - u0, v - v0
        top = (1 - a) * values[v0, u0] + a * values[v0, u0 + 1]
        bottom = (1 - a) * values[v0 + 1, u0] + a * values[v0 + 1, u0 + 1]
        samples[i] = (1 - b) * top + b * bottom
    return samples


def lift(
    uv_px: FloatArray, depth_m: FloatArray, image_size_px: tuple[int, int], metres_per_px: FloatArray
) -> FloatArray:
    """Markers in F_S: ((u − c_u) s_x, (v − c_v) s_y, −h), (n, 3) m.

    Args:
        uv_px: (n, 2).
        depth_m: (n,) indentation h, positive = pressed in.
        image_size_px: (W, H); c is the image's centre ((W − 1)/2, (H − 1)/2).
        metres_per_px: (s_x, s_y).
    """
    c = (np.asarray(image_size_px, dtype=np.float64) - 1.0) / 2.0
    xy = (uv_px - c) * np.asarray(metres_per_px)  # (n, 2)
    return np.column_stack([xy, -depth_m])


def select_markers(depth_m: FloatArray, keep: int = 8, discard: int = 3) -> NDArray[np.intp]:
    """Indices of the paper's markers: drop the ``discard`` deepest, take the next ``keep``, deepest first.

    Raises:
        PerceptionError: fewer markers with a depth than discard + keep.
    """
    seen = np.flatnonzero(np.isfinite(depth_m))
    if len(seen) < keep + discard:
        raise PerceptionError(
            f"{len(seen)} markers have a depth; selection needs {keep + discard} ({discard} + {keep})"
        )
    order = seen[np.argsort(-depth_m[seen], kind="stable")]
    return np.asarray(order[discard : discard + keep], dtype=np.intp)
