"""The loops over frames behind ``tip_map_solver.py`` and ``anchor.py``, compiled; the equations are explained there.

``_turn`` stands in ``kernels.py`` too: compiled loops call such of their own module only (``compiled.py``).
"""

from __future__ import annotations

import numpy as np

from tiptrace.compiled import compiled
from tiptrace.types import FloatArray


@compiled
def _turn(E: FloatArray, w: FloatArray) -> None:
    """Rodrigues: E (3, 3) becomes the rotation by w (3,)."""
    x, y, z = w[0], w[1], w[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    E[0, 0], E[0, 1], E[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    E[1, 0], E[1, 1], E[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    E[2, 0], E[2, 1], E[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@compiled
def _levers(B: FloatArray, lever: FloatArray) -> None:
    """B (3, 6) becomes [−[lever]×, I]."""
    B[:] = 0.0
    B[0, 1], B[0, 2] = lever[2], -lever[1]
    B[1, 0], B[1, 2] = -lever[2], lever[0]
    B[2, 0], B[2, 1] = lever[1], -lever[0]
    B[0, 3] = B[1, 4] = B[2, 5] = 1.0


@compiled
def _spread(S: FloatArray, B: FloatArray, Sigma: FloatArray, extra: float) -> None:
    """S (3, 3) becomes B Σ Bᵀ + extra I, with B (3, 6) and Σ (6, 6)."""
    for i in range(3):
        for j in range(3):
            S[i, j] = extra if i == j else 0.0
        for m in range(6):
            total = 0.0
            for n in range(6):
                total += B[i, n] * Sigma[n, m]
            for j in range(3):
                S[i, j] += total * B[j, m]


@compiled
def _inverse(out: FloatArray, S: FloatArray) -> None:
    """Out (3, 3) becomes S⁻¹, by cofactors."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            out[j, i] = S[a, c] * S[b, d] - S[a, d] * S[b, c]
    scale = 1.0 / (S[0, 0] * out[0, 0] + S[0, 1] * out[1, 0] + S[0, 2] * out[2, 0])
    for i in range(3):
        for j in range(3):
            out[i, j] *= scale


@compiled
def linearise(
    theta: FloatArray,
    delta: FloatArray,
    T_B_E: FloatArray,
    velocity_B: FloatArray,
    rate_E: FloatArray,
    R: FloatArray,
    t: FloatArray,
    centre: FloatArray,
    Sigma: FloatArray,
    shares: FloatArray,
    variance: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Frames of Stage I at the corrected motions.

    Args:
        theta: (n,) unknowns: c, p, G, τ, then ċ and steps.
        delta: (T, 6) corrections of the motions.
        T_B_E: (T, 4, 4) hand.
        velocity_B: (T, 3) of it.
        rate_E: (T, 3) its angular velocity.
        R: (T, 3, 3) motions.
        t: (T, 3) the same.
        centre: (T, 3) where their rotation noise acts.
        Sigma: (T, 6, 6) their covariance.
        shares: (T, 1 + K) of ċ and the steps in c_t.
        variance: Added to each axis, m².

    Returns:
        A (T, 3, n), S⁻¹ (T, 3, 3), misclosure (T, 3), lever (T, 3).
    """
    T, n = len(R), len(theta)
    A, S_inv = np.zeros((T, 3, n)), np.empty((T, 3, 3))
    w, levers = np.empty((T, 3)), np.empty((T, 3))
    E, B, S = np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    c, q, u, du, lever_0, lever = (
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
    )
    for f in range(T):
        for i in range(3):
            c[i] = theta[i]
            for k in range(shares.shape[1]):
                c[i] += shares[f, k] * theta[16 + 3 * k + i]
        for i in range(3):
            q[i] = 0.0
            for j in range(3):
                q[i] += T_B_E[f, j, i] * (theta[3 + j] - T_B_E[f, j, 3])
        for i in range(3):
            u[i] = q[i] - c[i]
            a, b = (i + 1) % 3, (i + 2) % 3
            du[i] = rate_E[f, b] * q[a] - rate_E[f, a] * q[b]
            for j in range(3):
                du[i] -= T_B_E[f, j, i] * velocity_B[f, j]
        _turn(E, delta[f, :3])
        for i in range(3):
            lever_0[i] = t[f, i] - centre[f, i]
            for j in range(3):
                lever_0[i] += R[f, i, j] * c[j]
        for i in range(3):
            lever[i] = E[i, 0] * lever_0[0] + E[i, 1] * lever_0[1] + E[i, 2] * lever_0[2]
            levers[f, i] = lever[i]
        _levers(B, lever)
        _spread(S, B, Sigma[f], variance)
        _inverse(S_inv[f], S)
        for i in range(3):
            r = lever[i] + centre[f, i] + delta[f, 3 + i] - c[i]
            for j in range(3):
                g = theta[6 + 3 * i + j]
                A[f, i, j] = E[i, 0] * R[f, 0, j] + E[i, 1] * R[f, 1, j] + E[i, 2] * R[f, 2, j] + g
                for k in range(3):
                    A[f, i, 3 + k] -= g * T_B_E[f, k, j]
                A[f, i, 6 + 3 * i + j] = -u[j]
                A[f, i, 15] += du[j] * g
                r -= u[j] * g
            A[f, i, i] -= 1.0
            for k in range(6):
                r -= B[i, k] * delta[f, k]
            w[f, i] = r
            for k in range(shares.shape[1]):
                for j in range(3):
                    A[f, i, 16 + 3 * k + j] = shares[f, k] * A[f, i, j]
    return A, S_inv, w, levers


@compiled
def normal_equations(
    A: FloatArray, S_inv: FloatArray, w: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Σ Aᵀ W A (n, n) and −Σ Aᵀ W w (n,) with W = weight S⁻¹, over frames A (T, 3, n), S⁻¹ (T, 3, 3), w (T, 3)."""
    T, _, n = A.shape
    N, b, WA = np.zeros((n, n)), np.zeros(n), np.empty((3, n))
    for f in range(T):
        if weights[f] == 0.0:
            continue
        for i in range(3):
            for k in range(n):
                WA[i, k] = weights[f] * (
                    S_inv[f, i, 0] * A[f, 0, k] + S_inv[f, i, 1] * A[f, 1, k] + S_inv[f, i, 2] * A[f, 2, k]
                )
        for i in range(3):
            for j in range(n):
                a = A[f, i, j]
                if a != 0.0:
                    for k in range(n):
                        N[j, k] += a * WA[i, k]
                b[j] -= WA[i, j] * w[f, i]
    return N, b


@compiled
def corrections(
    A: FloatArray, S_inv: FloatArray, w: FloatArray, lever: FloatArray, Sigma: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What a step (n,) leaves: whitened lengths (T,) of the misclosures, corrections (T, 6) of the motions."""
    T, _, n = A.shape
    length, delta = np.empty(T), np.empty((T, 6))
    left, k = np.empty(3), np.empty(6)  # k: [lever × S⁻¹ left, S⁻¹ left]
    for f in range(T):
        for i in range(3):
            left[i] = w[f, i]
            for j in range(n):
                left[i] += A[f, i, j] * step[j]
        square = 0.0
        for i in range(3):
            k[3 + i] = S_inv[f, i, 0] * left[0] + S_inv[f, i, 1] * left[1] + S_inv[f, i, 2] * left[2]
            square += left[i] * k[3 + i]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            k[i] = lever[f, a] * k[3 + b] - lever[f, b] * k[3 + a]
        length[f] = np.sqrt(max(square, 0.0))
        for i in range(6):
            delta[f, i] = 0.0
            for j in range(6):
                delta[f, i] -= Sigma[f, i, j] * k[j]
    return length, delta


@compiled
def spurious(Sigma: FloatArray, S_inv: FloatArray, R: FloatArray, weights: FloatArray) -> FloatArray:
    """Σ weight Rᵀ E[[δω]ᵀ S⁻¹ [δω]] R, (3, 3): what noise Σ (T, 3, 3) of the rotations R seems to say."""
    K = np.zeros((3, 3, 3))  # [e_m]×
    for m in range(3):
        a, b = (m + 1) % 3, (m + 2) % 3
        K[m, a, b], K[m, b, a] = -1.0, 1.0
    out, E, SK = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for f in range(len(R)):
        E[:] = 0.0
        for n in range(3):
            SK[:] = 0.0
            for i in range(3):
                for k in range(3):
                    for j in range(3):
                        SK[i, j] += S_inv[f, i, k] * K[n, k, j]
            for m in range(3):
                for k in range(3):
                    for i in range(3):
                        a = Sigma[f, m, n] * K[m, k, i]
                        if a != 0.0:
                            for j in range(3):
                                E[i, j] += a * SK[k, j]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    a = weights[f] * R[f, k, i]
                    for m in range(3):
                        out[i, j] += a * E[k, m] * R[f, m, j]
    return out


@compiled
def fixed_point_rows(
    theta: FloatArray, delta: FloatArray, R: FloatArray, t: FloatArray, Sigma: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Poses (T, 3, 3), (T, 3) that turn about a point, at the corrected poses; theta (6,) is c, p.

    Returns:
        A (T, 3, 6), S⁻¹ (T, 3, 3), misclosure (T, 3), uncorrected lever (T, 3).
    """
    T = len(R)
    A, S_inv = np.zeros((T, 3, 6)), np.empty((T, 3, 3))
    w, levers = np.empty((T, 3)), np.empty((T, 3))
    E, B, S, lever = np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3)), np.empty(3)
    for f in range(T):
        _turn(E, delta[f, :3])
        for i in range(3):
            levers[f, i] = t[f, i] - centre[f, i]
            for j in range(3):
                levers[f, i] += R[f, i, j] * theta[j]
        for i in range(3):
            lever[i] = E[i, 0] * levers[f, 0] + E[i, 1] * levers[f, 1] + E[i, 2] * levers[f, 2]
            for j in range(3):
                A[f, i, j] = E[i, 0] * R[f, 0, j] + E[i, 1] * R[f, 1, j] + E[i, 2] * R[f, 2, j]
            A[f, i, 3 + i] = -1.0
        # the correction shifts the point itself: the lever of the noise is y − centre
        for i in range(3):
            w[f, i] = lever[i] + centre[f, i] + delta[f, 3 + i] - theta[3 + i]
            lever[i] += delta[f, 3 + i]
        _levers(B, lever)
        _spread(S, B, Sigma[f], 0.0)
        _inverse(S_inv[f], S)
        for i in range(3):
            for k in range(6):
                w[f, i] -= B[i, k] * delta[f, k]
    return A, S_inv, w, levers
