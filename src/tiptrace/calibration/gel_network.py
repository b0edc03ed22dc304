"""Train the gel network: a small fully connected inverse of the shading model, with the camera's noise."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.calibration.gel_shading import Shading
from tiptrace.errors import MissingExtraError
from tiptrace.perception.gel_model import Convention
from tiptrace.types import FloatArray

HIDDEN = (32, 32)
_SAMPLES = 120_000
_RATES = ((3e-3, 12), (1e-3, 8), (3e-4, 6), (1e-4, 4))  # Adam: rate, epochs
_FLAT_SHARE = 0.15
_BEYOND = 1.3  # the network is taught slopes up to this multiple of the steepest seen …
_STEEPEST = 1.8  # … but never above this

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Network:
    """Weights (n_in, n_out) and biases of each layer, input scaling folded in."""

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    loss: float


def train_network(
    shadings: Sequence[Shading],
    background: NDArray[np.float32],
    noise_bgr: FloatArray,
    convention: Convention,
    rng: np.random.Generator,
    progress: Progress | None = None,
    *,
    steepest: float | None = None,
) -> Network:
    """Teach the inverse: colour ratio and place in, unit normal out.

    Args:
        shadings: What to invert; samples come evenly from several gels.
        background: (H, W, 3) grey levels of the untouched gel.
        noise_bgr: (3,) standard deviation of the camera's noise, grey levels.
        convention: How the network will be fed.
        rng: Decides samples and initial weights.
        progress: Called with a label and the share done.
        steepest: Slope up to which is taught; None: what the presses showed and a little more.

    Raises:
        MissingExtraError: scikit-learn is not installed.
    """
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor
    except ImportError:
        raise MissingExtraError("scikit-learn", "calibrate") from None
    if steepest is None:
        steepest = min(_BEYOND * max(s.max_slope for s in shadings), _STEEPEST)
    X, Y = _samples(shadings, steepest, background, noise_bgr, convention, rng)
    mean, scale = X.mean(axis=0), X.std(axis=0) + 1e-6
    X = ((X - mean) / scale).astype(np.float32)
    model = MLPRegressor(
        hidden_layer_sizes=HIDDEN,
        batch_size=500,
        alpha=1e-6,
        warm_start=True,
        random_state=int(rng.integers(2**31)),
    )
    epochs = sum(n for _, n in _RATES)
    done = 0
    for rate, n in _RATES:
        model.set_params(learning_rate_init=rate, max_iter=n, n_iter_no_change=n + 1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            model.fit(X, Y.astype(np.float32))
        done += n
        if progress is not None:
            progress("training the network", done / epochs)
    weights = [np.asarray(W, dtype=np.float64) for W in model.coefs_]
    biases = [np.asarray(b, dtype=np.float64) for b in model.intercepts_]
    weights[0] = weights[0] / scale[:, None]
    biases[0] = biases[0] - mean @ weights[0]
    return Network(
        tuple(W.astype(np.float32) for W in weights),
        tuple(b.astype(np.float32) for b in biases),
        float(model.loss_),
    )


def _samples(
    shadings: Sequence[Shading],
    steepest: float,
    background: NDArray[np.float32],
    noise_bgr: FloatArray,
    convention: Convention,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Inputs (n, 5) and normals (n_x, n_y), (n, 2): slopes even in every direction, places even over the image."""
    H, W = background.shape[:2]
    v, u = rng.integers(0, H, _SAMPLES), rng.integers(0, W, _SAMPLES)
    unit_uv = np.stack([u / W, v / H], axis=1)
    slope = steepest * rng.uniform(0.0, 1.0, _SAMPLES)
    slope[rng.uniform(size=_SAMPLES) < _FLAT_SHARE] = 0.0
    direction = rng.uniform(0.0, 2.0 * np.pi, _SAMPLES)
    slopes = slope[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    B = background[v, u].astype(np.float64)
    change = np.empty((_SAMPLES, 3))
    for g, shading in enumerate(shadings):
        own = slice(g, None, len(shadings))
        change[own] = shading.ratio_change(slopes[own], unit_uv[own])
    colours = B * (1.0 + change) + noise_bgr * rng.standard_normal((_SAMPLES, 3))
    colours = np.clip(colours, 0.0, 255.0)
    place = unit_uv if convention.coordinates == "unit" else np.zeros_like(unit_uv)
    X = np.concatenate([colours / np.maximum(B, 1.0) - 1.0, place], axis=1)
    return X, -slopes / np.sqrt(1.0 + slope**2)[:, None]  # n = (−p, −q, 1)/√(1 + p² + q²)
