"""What every frame costs, as compiled loops: rigid fit of a template, its residuals, poses smoothed at an instant.

The derivations are where the loops are called from: ``motion.py``, ``pose_track.py``.
"""

from __future__ import annotations

import numpy as np

from tiptrace.compiled import compiled
from tiptrace.types import FloatArray, IntArray

_UNKNOWNS = 10  # of a frame: ω, v, and a tilt (a, b) of each pad's depth


@compiled
def _exp(w: FloatArray) -> FloatArray:
    """Rodrigues, (3,) → (3, 3)."""
    x, y, z = w[0], w[1], w[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    return R


@compiled
def _log(A: FloatArray, B: FloatArray) -> tuple[float, float, float]:
    """Rotation vector of Aᵀ B, both (3, 3)."""
    x, y, z, trace = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        x += A[i, 2] * B[i, 1] - A[i, 1] * B[i, 2]
        y += A[i, 0] * B[i, 2] - A[i, 2] * B[i, 0]
        z += A[i, 1] * B[i, 0] - A[i, 0] * B[i, 1]
        trace += A[i, 0] * B[i, 0] + A[i, 1] * B[i, 1] + A[i, 2] * B[i, 2]
    x, y, z = 0.5 * x, 0.5 * y, 0.5 * z
    s2 = x * x + y * y + z * z
    cosine = 0.5 * (trace - 1.0)
    if s2 < 0.04 and cosine > 0.0:
        k = 1.0 + s2 / 6.0 + 0.075 * s2 * s2  # arcsin(s) / s
    else:
        s = np.sqrt(s2)
        k = np.arctan2(s, cosine) / max(s, 1e-12)
    return k * x, k * y, k * z


@compiled
def _times(A: FloatArray, B: FloatArray) -> FloatArray:
    """Product of two (3, 3)."""
    C = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for j in range(3):
                C[i, j] += A[i, k] * B[k, j]
    return C


@compiled
def _cholesky(H: FloatArray) -> FloatArray:
    """Lower factor of a positive definite (n, n)."""
    n = len(H)
    L = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            total = H[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
    return L


@compiled
def _solve(L: FloatArray, b: FloatArray) -> FloatArray:
    """H⁻¹ b from the factor of H, (n, n) and (n,) → (n,)."""
    n = len(b)
    x = b.copy()
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x


@compiled
def _residual(X: FloatArray, M: FloatArray, R: FloatArray, t: FloatArray) -> tuple[float, float, float]:
    """One marker less its place on the moved template."""
    return (
        X[0] - (R[0, 0] * M[0] + R[0, 1] * M[1] + R[0, 2] * M[2] + t[0]),
        X[1] - (R[1, 0] * M[0] + R[1, 1] * M[1] + R[1, 2] * M[2] + t[1]),
        X[2] - (R[2, 0] * M[0] + R[2, 1] * M[1] + R[2, 2] * M[2] + t[2]),
    )


@compiled
def _whitened(
    X: FloatArray, M: FloatArray, whiten: FloatArray, weights: FloatArray, R: FloatArray, t: FloatArray
) -> FloatArray:
    """Residuals of one frame along the pads' axes in sigmas, (n, 3); 0 without weight."""
    z = np.zeros(M.shape)
    for i in range(len(M)):
        if weights[i] > 0.0:
            r = _residual(X[i], M[i], R, t)
            for j in range(3):
                z[i, j] = whiten[i, j, 0] * r[0] + whiten[i, j, 1] * r[1] + whiten[i, j, 2] * r[2]
    return z


@compiled
def _normal_equations(
    z: FloatArray, J: FloatArray, JJ: FloatArray, prior: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """H (10, 10) and b (10,) of the weighted rows."""
    H, b = prior.copy(), np.zeros(_UNKNOWNS)
    flat = H.reshape(_UNKNOWNS * _UNKNOWNS)
    for i in range(len(z)):
        w = weights[i]
        if w > 0.0:
            for k in range(_UNKNOWNS * _UNKNOWNS):
                flat[k] += w * JJ[i, k]
            for j in range(3):
                for k in range(_UNKNOWNS):
                    b[k] += w * z[i, j] * J[i, j, k]
    return H, b


@compiled
def _reweigh(
    z: FloatArray, J: FloatArray, x: FloatArray, trust: FloatArray, huber: float, weights: FloatArray
) -> tuple[float, float]:
    """Robust weights, set in place, from what a step x leaves; sums of squares in the pads' plane and overall."""
    in_plane = overall = 0.0
    for i in range(len(z)):
        if weights[i] > 0.0:
            square = across = 0.0
            for j in range(3):
                left = z[i, j]
                for k in range(_UNKNOWNS):
                    left -= J[i, j, k] * x[k]
                square += left * left
                if j < 2:
                    across += left * left
            weights[i] = trust[i] * huber / max(np.sqrt(square), huber)
            in_plane += trust[i] * across
            overall += weights[i] * square
    return in_plane, overall


@compiled
def _move(R: FloatArray, t: FloatArray, g: FloatArray, x: FloatArray) -> None:
    """Turn and shift a motion, in place, by x = (ω, v, …) about the moved point g."""
    E = _exp(x[:3])
    lever = np.empty(3)
    for i in range(3):
        lever[i] = R[i, 0] * g[0] + R[i, 1] * g[1] + R[i, 2] * g[2]  # from t to the moved g
    for i in range(3):
        t[i] += lever[i] - (E[i, 0] * lever[0] + E[i, 1] * lever[1] + E[i, 2] * lever[2]) + x[3 + i]
    R[:] = _times(E, R)


@compiled
def fit_frames(
    X: FloatArray,
    R: FloatArray,
    t: FloatArray,
    M: FloatArray,
    whiten: FloatArray,
    J: FloatArray,
    JJ: FloatArray,
    prior: FloatArray,
    trust: FloatArray,
    g: FloatArray,
    huber: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Robust rigid fits of T frames to a template of n markers.

    Args:
        X: (T, n, 3) markers, NaN where lost.
        R: (T, 3, 3) start; the result afterwards.
        t: (T, 3) the same.
        M: (n, 3) template.
        whiten: (n, 3, 3) from a residual to (u, v, normal) in sigmas.
        J: (n, 3, 10) whitened Jacobian.
        JJ: (n, 100) its squares ``JᵀJ`` of each marker.
        prior: (10, 10) information on the unknowns.
        trust: (n,) weights, > 0.
        g: (3,) point of the template about which it turns.
        huber: Limit of the robust weights in sigmas.
        iterations: Gauss-Newton steps.

    Returns:
        Covariance (T, 6, 6) of (ω, v); robust weights (T, n), 0 where lost; sums (T, 2) of squared residuals in
        sigmas: in the pads' plane under ``trust``, overall under the robust weights.
    """
    T, n = X.shape[0], X.shape[1]
    covariance, weights, squares = np.empty((T, 6, 6)), np.zeros((T, n)), np.zeros((T, 2))
    L, unit = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.eye(_UNKNOWNS)
    for f in range(T):
        for i in range(n):
            if np.isfinite(X[f, i, 0]):
                weights[f, i] = trust[i]
        for _ in range(iterations):
            z = _whitened(X[f], M, whiten, weights[f], R[f], t[f])
            H, b = _normal_equations(z, J, JJ, prior, weights[f])
            L = _cholesky(H)
            x = _solve(L, b)
            squares[f, 0], squares[f, 1] = _reweigh(z, J, x, trust, huber, weights[f])
            _move(R[f], t[f], g, x)
        for k in range(6):
            covariance[f, k] = _solve(L, unit[k])[:6]
    return covariance, weights, squares


@compiled
def residuals_in_plane(
    X: FloatArray, R: FloatArray, t: FloatArray, M: FloatArray, normals: FloatArray
) -> FloatArray:
    """Markers (T, n, 3) less their places on the moved template, without what is along the normals (n, 3)."""
    out = np.empty(X.shape)
    for f in range(len(X)):
        for i in range(len(M)):
            r = _residual(X[f, i], M[i], R[f], t[f])
            along = r[0] * normals[i, 0] + r[1] * normals[i, 1] + r[2] * normals[i, 2]
            for j in range(3):
                out[f, i, j] = r[j] - along * normals[i, j]
    return out


@compiled
def smooth_poses(
    stamps_ns: FloatArray, T_B_E: FloatArray, at_ns: FloatArray, first: IntArray, width: int, half_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Local quadratic regression of poses (K,), (K, 4, 4) at instants (T,), each from ``width`` samples from ``first``.

    Returns:
        T_B_E (T, 4, 4), velocity (T, 3) in F_B, angular velocity (T, 3) in F_E.
    """
    T = np.zeros((len(at_ns), 4, 4))
    velocity, rate = np.empty((len(at_ns), 3)), np.empty((len(at_ns), 3))
    for f in range(len(at_ns)):
        start = first[f]
        R_ref, t_ref = T_B_E[start + width // 2, :3, :3], T_B_E[start, :3, 3]
        N, b = 1e-9 * np.eye(3), np.zeros((6, 3))
        v, y = np.ones(3), np.empty(6)
        for k in range(start, start + width):
            v[1] = (stamps_ns[k] - at_ns[f]) * 1e-9 / half_s
            v[2] = v[1] * v[1]
            weight = max(1.0 - v[2], 1e-6)
            y[0], y[1], y[2] = _log(R_ref, T_B_E[k, :3, :3])
            for j in range(3):
                y[3 + j] = T_B_E[k, j, 3] - t_ref[j]
                for i in range(3):
                    N[j, i] += weight * v[j] * v[i]
            for c in range(6):
                for j in range(3):
                    b[c, j] += weight * v[j] * y[c]
        L = _cholesky(N)
        w = np.empty(3)
        for c in range(3):
            beta, beta_t = _solve(L, b[c]), _solve(L, b[3 + c])
            w[c], rate[f, c] = beta[0], beta[1] / half_s
            T[f, c, 3], velocity[f, c] = beta_t[0] + t_ref[c], beta_t[1] / half_s
        T[f, :3, :3] = _times(R_ref, _exp(w))
        T[f, 3, 3] = 1.0
    return T, velocity, rate
