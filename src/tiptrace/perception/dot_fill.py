"""Slopes under round dots, continued along the structure that crosses them.

At the edge of a tool the slope changes fast across the edge and hardly along it. Around each dot the direction of
least change is found from the slopes on a ring; each pixel under the dot takes the values where the line through
it in that direction leaves the dot, weighted by nearness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import BoolArray, FloatArray

Float32Map = NDArray[np.float32]

_RING_POINTS = 48
_LEAST_ENDS = 11  # points that must be seen for a direction to be judged
_VARIED = 0.04  # standard deviation of the slope around a dot below which the smooth fill is left as it is


class DotFill:
    """Fills discs of one radius in maps."""

    def __init__(self, radius_px: float, outside_px: float = 1.0) -> None:
        """For discs of a radius; values are taken so much outside them. Map pixels."""
        self._radius, self._outside = radius_px, outside_px
        angle = 2.0 * np.pi * np.arange(_RING_POINTS) / _RING_POINTS
        self._double = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (m, 2)
        self._ring = (radius_px + outside_px) * self._double  # (m, 2)

    def apply(self, planes: Float32Map, uv: FloatArray) -> None:
        """Overwrite discs at places (n, 2), map px, in smoothly filled maps (c, H, W)."""
        directions, sure = _directions(planes, uv, self._ring, self._double)
        _borrow_from_nearest(directions, sure, uv)
        _fill_discs(planes, uv, directions, self._radius, self._outside)


@compiled
def _directions(
    planes: Float32Map, uv: FloatArray, ring: FloatArray, double: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Unit direction (n, 2) of least change across each dot, NaN where nothing changes; is it seen all round (n,)?"""
    n, m, C = len(uv), len(ring), planes.shape[0]
    directions, sure = np.full((n, 2), np.nan), np.zeros(n, dtype=np.bool_)
    values, seen = np.empty((C, 3 * m), dtype=np.float32), np.empty(3 * m, dtype=np.float32)
    cost = np.empty(m)
    for i in range(n):
        if not _varies(planes, uv[i, 0], uv[i, 1], ring):
            continue
        sure[i] = True
        for k in range(m):
            u, v = uv[i, 0] + ring[k, 0], uv[i, 1] + ring[k, 1]
            inside = _inside(planes, u, v)
            sure[i] &= inside
            seen[k::m] = np.float32(inside)
            for c in range(C):
                values[c, k::m] = _sample(planes[c], u, v)
        _disagreement(values, seen, cost)
        _add_steps_at_touch(values, seen, double, cost)
        theta = _lowest(cost)
        directions[i, 0], directions[i, 1] = np.cos(theta), np.sin(theta)
    return directions, sure


@compiled
def _varies(planes: Float32Map, u: float, v: float, ring: FloatArray) -> bool:
    """Whether the standard deviation of any map over some points of the ring is large."""
    for c in range(planes.shape[0]):
        total, squares, count = 0.0, 0.0, 0
        for k in range(0, len(ring), 6):
            value = float(_sample(planes[c], u + ring[k, 0], v + ring[k, 1]))
            total += value
            squares += value * value
            count += 1
        if squares / count - (total / count) ** 2 > _VARIED**2:
            return True
    return False


@compiled
def _disagreement(values: Float32Map, seen: Float32Map, cost: FloatArray) -> None:
    """Mean square difference between the ends of the ring's chords at each angle π d/m.

    Values (c, 3 m) and whether they are in the map (3 m,) go round the ring three times. Chords at the angle π d/m end
    at points k and k' with k + k' = d + m/2; among them are two single points where that is even.
    """
    m = len(cost)
    back, back_seen = values[:, ::-1].copy(), seen[::-1].copy()
    for d in range(m):
        odd = (d + m // 2) % 2
        middle = (d + m // 2) // 2 + m
        chords, ahead, behind = m // 2 - 1 + odd, middle + 1, 3 * m - middle - odd
        w, w_back = seen[ahead : ahead + chords], back_seen[behind : behind + chords]
        squares, count = np.float32(0.0), np.float32(0.0)
        for c in range(values.shape[0]):
            x, y = values[c, ahead : ahead + chords], back[c, behind : behind + chords]
            for j in range(chords):
                squares += w[j] * w_back[j] * (x[j] - y[j]) * (x[j] - y[j])
        for j in range(chords):
            count += w[j] * w_back[j]
        points = 2.0 * count + (1 - odd) * (seen[middle] + seen[middle + m // 2])
        cost[d] = 2.0 * squares / points if points > _LEAST_ENDS else np.inf


@compiled
def _add_steps_at_touch(values: Float32Map, seen: Float32Map, double: FloatArray, cost: FloatArray) -> None:
    """Add the mean square step along the ring where chords at each angle touch it.

    A ridge through the dot's middle looks the same from both sides and from both ends; chords along it touch the ring
    where the values do not change. ``double`` (m, 2): cosine and sine of twice the angles π k/m of the chords.
    """
    m = len(cost)
    total, total_cos, total_sin = 0.0, 0.0, 0.0
    for k in range(m):
        square = 0.0
        for c in range(values.shape[0]):
            square += seen[k] * seen[k + 1] * (values[c, k + 1] - values[c, k]) ** 2
        total += square
        at = (2 * k + 1) % m  # the step lies at the angle 2 π (k + ½)/m
        total_cos += square * double[at, 0]
        total_sin += square * double[at, 1]
    for d in range(m):
        cost[d] += 0.5 / m * (total - total_cos * double[d, 0] - total_sin * double[d, 1])


@compiled
def _lowest(cost: FloatArray) -> float:
    """Angle of the least cost (m,), refined by a parabola."""
    m = len(cost)
    best = np.argmin(cost)
    low, mid, high = cost[(best - 1) % m], cost[best], cost[(best + 1) % m]
    curvature = low - 2.0 * mid + high
    shift = 0.5 * (low - high) / curvature if 0.0 < curvature < np.inf else 0.0
    return float(np.pi * (best + min(max(shift, -0.5), 0.5)) / m)


@compiled
def _borrow_from_nearest(directions: FloatArray, sure: BoolArray, uv: FloatArray) -> None:
    """Give each dot near the border the direction of the nearest one that is seen all round."""
    for i in range(len(uv)):
        if sure[i] or np.isnan(directions[i, 0]):
            continue
        nearest = np.inf
        for j in range(len(uv)):
            distance = (uv[i, 0] - uv[j, 0]) ** 2 + (uv[i, 1] - uv[j, 1]) ** 2
            if sure[j] and distance < nearest:
                nearest = distance
                directions[i] = directions[j]


@compiled
def _fill_discs(
    planes: Float32Map, uv: FloatArray, directions: FloatArray, radius: float, outside: float
) -> None:
    """Between the two ends of the chord along a dot's direction, each pixel takes their mean by nearness."""
    C, H, W = planes.shape
    half = int(np.ceil(radius)) + 1
    for i in range(len(uv)):
        a, b = directions[i]
        if np.isnan(a):
            continue
        u0, v0 = round(uv[i, 0]), round(uv[i, 1])
        for v in range(max(v0 - half, 0), min(v0 + half + 1, H)):
            for u in range(max(u0 - half, 0), min(u0 + half + 1, W)):
                du, dv = u - uv[i, 0], v - uv[i, 1]
                inside = radius * radius - du * du - dv * dv
                if inside <= 0.0:
                    continue
                along = du * a + dv * b
                reach = np.sqrt(inside + along * along) + outside
                ahead, behind = reach - along, reach + along
                front_seen = _inside(planes, u + ahead * a, v + ahead * b)
                back_seen = _inside(planes, u - behind * a, v - behind * b)
                w = np.float32(behind / (ahead + behind) if front_seen == back_seen else front_seen)
                if not (front_seen or back_seen):
                    w = np.float32(0.5)
                for c in range(C):
                    front = _sample(planes[c], u + ahead * a, v + ahead * b)
                    back = _sample(planes[c], u - behind * a, v - behind * b)
                    planes[c, v, u] = w * front + (np.float32(1.0) - w) * back


@compiled
def _inside(planes: Float32Map, u: float, v: float) -> bool:
    return bool(0.0 <= u <= planes.shape[2] - 1 and 0.0 <= v <= planes.shape[1] - 1)


@compiled
def _sample(plane: Float32Map, u: float, v: float) -> np.float32:
    """Bilinear, constant beyond the border."""
    H, W = plane.shape
    x, y = min(max(u, 0.0), W - 1.0), min(max(v, 0.0), H - 1.0)
    u0, v0 = min(int(x), W - 2), min(int(y), H - 2)
    a, b = np.float32(x - u0), np.float32(y - v0)
    top = plane[v0, u0] + a * (plane[v0, u0 + 1] - plane[v0, u0])
    bottom = plane[v0 + 1, u0] + a * (plane[v0 + 1, u0 + 1] - plane[v0 + 1, u0])
    return np.float32(top + b * (bottom - top))
