"""The contact patch from the markers' motion alone."""

import numpy as np
import pytest

from tiptrace.perception.planar import MotionPatch
from tiptrace.types import BoolArray, FloatArray

PITCH = 32.0


def gel() -> FloatArray:
    """7 × 9 markers, (63, 2) px."""
    u, v = np.meshgrid(32.0 + PITCH * np.arange(9), 24.0 + PITCH * np.arange(7))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def drag(rest: FloatArray, patch: BoolArray, shift: FloatArray, angle: float) -> FloatArray:
    """Markers (n, 2) px under a tool that moves and turns about the middle; beside it they follow less and less."""
    r = rest - rest.mean(axis=0)
    c, s = np.cos(angle), np.sin(angle)
    tool = r @ np.array([[c, s], [-s, c]]) - r + shift
    away = np.linalg.norm(rest[:, None] - rest[patch], axis=2).min(axis=1) / PITCH
    return np.asarray(rest + np.where(patch, 1.0, 0.4 * np.exp(1.0 - away))[:, None] * tool)


def followed(motion: list[tuple[FloatArray, float]], patch: BoolArray, noise_px: float = 0.05) -> BoolArray:
    rest, rng = gel(), np.random.default_rng(0)
    found = MotionPatch(rest)
    for shift, angle in [(np.zeros(2), 0.0), *motion]:
        uv = drag(rest, patch, shift, angle) + rng.normal(0.0, noise_px, rest.shape)
        told = found.update(uv, np.ones(len(rest), dtype=bool))
    return told


def test_patch_without_evidence_is_everything() -> None:
    patch = MotionPatch(gel())
    assert patch.update(gel() + 0.1, np.ones(63, bool)).all()
    assert patch.update(gel() + 0.3, np.ones(63, bool)).all()


@pytest.mark.parametrize("rows", [(3, 4), (2, 3, 4)])
def test_a_strip_that_shifts(rows: tuple[int, ...]) -> None:
    patch = np.isin(np.arange(63) // 9, rows)
    told = followed([(np.array([0.8 * t, 0.2 * t]), 0.0) for t in range(20)], patch)
    np.testing.assert_array_equal(told, patch)


def test_a_tool_that_turns_about_its_middle_has_markers_that_hardly_move() -> None:
    patch = np.isin(np.arange(63) // 9, (2, 3, 4))
    told = followed([(np.zeros(2), 0.005 * t) for t in range(20)], patch)
    middle = np.linalg.norm(gel() - gel().mean(axis=0), axis=1) < 1.5 * PITCH
    assert told[middle & patch].all()
    assert (told == patch).mean() > 0.85


def test_markers_that_slide_by_more_than_the_tool_are_not_the_tool() -> None:
    rest, patch = gel(), np.isin(np.arange(63) // 9, (3, 4))
    beside = np.isin(np.arange(63), (18, 19, 25, 26, 45, 46, 52, 53))
    rng, found = np.random.default_rng(1), MotionPatch(rest)
    for t in range(20):
        uv = drag(rest, patch, np.array([0.6 * t, 0.0]), 0.0)
        uv[beside] += rng.uniform(0.5, 2.0, (8, 1)) * t
        told = found.update(uv, np.ones(63, bool))
    np.testing.assert_array_equal(told, patch)


def test_few_or_lost_markers() -> None:
    few = MotionPatch(gel()[:3])
    for t in range(10):
        assert few.update(gel()[:3] + t, np.ones(3, bool)).all()
    lost = MotionPatch(gel())
    for _ in range(3):
        assert lost.update(np.full((63, 2), np.nan), np.zeros(63, bool)).all()
