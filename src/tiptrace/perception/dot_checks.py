"""Is a dot the one that was followed or looked for: loops over markers, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import BoolArray, FloatArray

_BACK_PX = 1.0  # forward–backward mismatch
_AREA = (0.4, 2.2)  # of the first frame's
INK = 0.45  # of the first frame's contrast


@compiled
def nearest_to_own(found: FloatArray, places: FloatArray, missing: NDArray[np.intp]) -> BoolArray:
    """Whether dots (m, 2) found for missing markers lie nearer to these than to any other marker's place (n, 2)."""
    own = np.ones(len(missing), dtype=np.bool_)
    for k in range(len(missing)):
        u, v = found[k]
        i = missing[k]
        away = (u - places[i, 0]) ** 2 + (v - places[i, 1]) ** 2
        for j in range(len(places)):
            own[k] &= j == i or away <= (u - places[j, 0]) ** 2 + (v - places[j, 1]) ** 2
    return own


@compiled
def part_twins(uv: FloatArray, off: FloatArray, seen: BoolArray, margin: float) -> None:
    """Of two markers on one dot, unmark the one that is further off its neighbours' displacement."""
    twice = seen.copy()
    for i in range(len(uv)):
        for j in range(i + 1, len(uv)):
            if twice[i] and twice[j] and (uv[i, 0] - uv[j, 0]) ** 2 + (uv[i, 1] - uv[j, 1]) ** 2 < margin**2:
                seen[i if off[i] > off[j] else j] = False


@compiled
def came_back(
    start: FloatArray, moved: FloatArray, back: FloatArray, found: BoolArray, leap: float
) -> BoolArray:
    """Those found that come back to where they started, and do not leap away from the others (all (n, 2), (n,))."""
    n = len(start)
    ok = np.empty(n, dtype=np.bool_)
    u, v, count = np.empty(n), np.empty(n), 0
    for i in range(n):
        ok[i] = found[i] and np.hypot(back[i, 0] - start[i, 0], back[i, 1] - start[i, 1]) < _BACK_PX
        if ok[i]:
            u[count], v[count] = moved[i, 0] - start[i, 0], moved[i, 1] - start[i, 1]
            count += 1
    if count == 0:
        return ok
    common_u, common_v = np.median(u[:count]), np.median(v[:count])
    for i in range(n):
        away = np.hypot(moved[i, 0] - start[i, 0] - common_u, moved[i, 1] - start[i, 1] - common_v)
        ok[i] &= away < leap
    return ok


@compiled
def look_alike(
    uv: FloatArray,
    ink: FloatArray,
    area: FloatArray,
    ink_0: FloatArray,
    area_0: FloatArray,
    guess: FloatArray,
    reach: FloatArray,
) -> BoolArray:
    """Whether dots have ink and area as in the first frame, within reach of where they were guessed (n,)."""
    ok = np.empty(len(uv), dtype=np.bool_)
    for i in range(len(uv)):
        ratio = area[i] / area_0[i]
        ok[i] = ink[i] > INK * ink_0[i] and _AREA[0] < ratio < _AREA[1]
        ok[i] &= np.hypot(uv[i, 0] - guess[i, 0], uv[i, 1] - guess[i, 1]) < reach[i]
    return ok


@compiled
def inside_by(uv: FloatArray, margin: float, width: int, height: int) -> BoolArray:
    """Whether places (n, 2) lie in an image, at least a margin from its outermost pixels."""
    ok = np.empty(len(uv), dtype=np.bool_)
    for i in range(len(uv)):
        ok[i] = margin <= uv[i, 0] <= width - 1 - margin and margin <= uv[i, 1] <= height - 1 - margin
    return ok
