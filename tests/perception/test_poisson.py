import numpy as np
import pytest

from tiptrace.errors import PerceptionError
from tiptrace.perception.poisson import PoissonSolver

from .gel_images import S_M, H, W, bump


@pytest.mark.parametrize("sigma_px", [3, 10, 30, 60])
@pytest.mark.parametrize("centre", [(159.5, 119.5), (120.0, 100.0)])
def test_bump_is_metric(sigma_px, centre):
    z, p, q = bump(1e-3, sigma_px, centre)
    found = PoissonSolver((H, W), (S_M, S_M)).integrate(p.astype(np.float32), q.astype(np.float32))
    assert np.ptp(found) == pytest.approx(np.ptp(z), rel=0.01)
    assert np.abs((found - found.mean()) - (z - z.mean())).max() < 0.01 * 1e-3


@pytest.mark.parametrize("shape", [(240, 320), (120, 160), (31, 57), (480, 640)])
@pytest.mark.parametrize(("p", "q"), [(0.1, 0.0), (0.0, -0.2), (0.05, 0.3)])
def test_tilt_is_exact_for_any_size_and_unequal_scales(shape, p, q):
    s_x, s_y = 62.5e-6, 70e-6
    v, u = np.indices(shape)
    z = p * u * s_x + q * v * s_y
    solver = PoissonSolver(shape, (s_x, s_y))
    found = solver.integrate(np.full(shape, p, np.float32), np.full(shape, q, np.float32))
    assert np.abs(found - (z - z.mean())).max() < 1e-4 * np.ptp(z)


def test_unequal_scales_on_a_bump():
    s_x, s_y = 50e-6, 80e-6
    v, u = np.indices((H, W))
    x, y, sigma = (u - 160) * s_x, (v - 120) * s_y, 1.5e-3
    z = -1e-3 * np.exp(-(x**2 + y**2) / (2 * sigma**2))
    p, q = (-z * a / sigma**2 for a in (x, y))
    found = PoissonSolver((H, W), (s_x, s_y)).integrate(p.astype(np.float32), q.astype(np.float32))
    assert np.abs((found - found.mean()) - (z - z.mean())).max() < 1e-5


def test_untouched_gel_is_exactly_zero():
    flat = np.zeros((H, W), np.float32)
    assert np.all(PoissonSolver((H, W), (S_M, S_M)).integrate(flat, flat) == 0)


def test_linear():
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(2, H, W)).astype(np.float32) for _ in range(2))
    solve = PoissonSolver((H, W), (1.0, 1.0)).integrate
    together = solve(*(2 * a + b))
    np.testing.assert_allclose(together, 2 * solve(*a) + solve(*b), atol=2e-4 * np.abs(together).max())


def test_curl_does_not_enter():
    """The rotational part of a noisy field is orthogonal to every surface."""
    v, u = np.indices((64, 64)).astype(np.float64)
    stream = np.sin(np.pi * u / 63) ** 2 * np.sin(np.pi * v / 63) ** 2
    p, q = np.gradient(stream, axis=0), -np.gradient(stream, axis=1)
    found = PoissonSolver((64, 64), (1.0, 1.0)).integrate(p.astype(np.float32), q.astype(np.float32))
    assert np.abs(found).max() < 1e-3 * np.abs(stream).max()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_one_bad_gradient_is_refused(bad):
    p = np.zeros((H, W), np.float32)
    p[3, 4] = bad
    with pytest.raises(PerceptionError, match="not finite"):
        PoissonSolver((H, W), (S_M, S_M)).integrate(p, np.zeros_like(p))


def test_wrong_size_is_refused():
    with pytest.raises(PerceptionError, match="expected"):
        PoissonSolver((H, W), (S_M, S_M)).integrate(
            np.zeros((W, H), np.float32), np.zeros((W, H), np.float32)
        )
