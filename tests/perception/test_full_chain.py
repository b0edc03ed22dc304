"""The full chain on analytic images: metric under dots, steady under lamps, honest about what is lost."""

import numpy as np
import pytest

from tiptrace.config import Sensor, Transform
from tiptrace.errors import PerceptionError
from tiptrace.perception.finger import Finger
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.settings import SensingConfig

from .gel_images import S_M, H, W, bump, grid, linear_gel, paint_dots, shade, to_uint8

SENSOR = Sensor(
    mm_per_px=(S_M * 1e3, S_M * 1e3),
    T_E_S=Transform(translation_m=(0, 0, 0.14), quaternion_xyzw=(0, 0, 0, 1)),
)
FULL = SensingConfig(method="full")


def gel_image(depth_m=0.0, shift=(0.0, 0.0), sigma_px=40.0, gain=1.0, noise=0.0, seed=0):
    _, p, q = bump(depth_m, sigma_px)
    return to_uint8(gain * paint_dots(shade(p, q), grid() + shift, 10), noise, seed)


def marker_errors(finger, markers, depth_m, sigma_px):
    z, _, _ = bump(depth_m, sigma_px)
    return markers.x_S[:, 2] - sample_map(z.astype(np.float32), markers.uv_px)


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize(("depth_m", "sigma_px"), [(0.2e-3, 20), (0.8e-3, 25), (1.0e-3, 45)])
def test_depth_under_dots_is_metric(step, depth_m, sigma_px):
    finger = Finger(SENSOR, linear_gel(), gel_image(), SensingConfig(method="full", depth_step=step))
    finger.sense(gel_image())
    markers = finger.sense(gel_image(depth_m, (1.5, -0.8), sigma_px))
    error = marker_errors(finger, markers, depth_m, sigma_px)
    assert np.nanstd(error) < 8e-6
    assert np.sqrt(np.nanmean(error**2)) < 15e-6
    assert finger.depth_m.shape == (H, W)
    assert finger.depth_m.dtype == np.float32
    assert np.nanmean((error / markers.depth_sigma_m) ** 2) < 2.0


@pytest.mark.parametrize("gain", [0.93, 1.05])
def test_lamps_do_not_tilt_the_depth(gain):
    finger = Finger(SENSOR, linear_gel(), gel_image(), FULL)
    finger.sense(gel_image(0.5e-3, noise=1.5))
    markers = finger.sense(gel_image(0.5e-3, gain=gain, noise=1.5, seed=1))
    error = marker_errors(finger, markers, 0.5e-3, 40)
    xy = markers.x_S[:, :2]
    tilt = np.linalg.lstsq(np.column_stack([xy, np.ones(len(xy))]), error, rcond=None)[0][:2]
    assert np.abs(tilt).max() < 2e-3
    assert np.nanstd(error) < 20e-6


def test_a_lost_marker_has_no_depth_and_keeps_its_row():
    finger = Finger(SENSOR, linear_gel(), gel_image(), FULL)
    first = finger.sense(gel_image())
    image = gel_image(shift=(1.0, 0.0))
    i = int(np.argmin(np.linalg.norm(first.uv_px - [160, 120], axis=1)))
    u, v = first.uv_px[i].round().astype(int)
    image[v - 9 : v + 10, u - 9 : u + 10] = image[0, 0]
    second = finger.sense(image)
    assert not second.tracked[i]
    assert np.isnan(second.x_S[i]).all()
    assert np.isnan(second.depth_sigma_m[i])
    assert second.tracked.sum() == len(second.tracked) - 1
    third = finger.sense(gel_image(shift=(2.0, 0.0)))
    assert third.tracked[i]
    np.testing.assert_allclose(third.uv_px[i] - first.uv_px[i], [2.0, 0.0], atol=0.15)


def test_without_a_network_the_patch_comes_from_motion():
    config = SensingConfig(method="full", depth="none", indentation_m=0.7e-3)
    finger = Finger(SENSOR, None, gel_image(), config)
    finger.sense(gel_image())
    patch = np.linalg.norm(grid() - [160, 120], axis=1) < 70
    for t in range(1, 6):
        image = paint_dots(shade(), grid() + np.where(patch[:, None], [1.2 * t, 0.4 * t], 0.0), 10)
        markers = finger.sense(to_uint8(image, 1.0, t))
    order = np.linalg.norm(finger.markers.uv_px[:, None] - grid()[None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(-markers.x_S[:, 2], np.where(patch[order], 0.7e-3, 0.0))
    assert finger.depth_m is None


def test_another_gel_than_the_rig_says():
    sensor = SENSOR.model_copy(update={"marker_pitch_mm": 1.2})
    finger = Finger(sensor, linear_gel(), gel_image(), FULL, side="right")
    with pytest.raises(PerceptionError, match=r"right finger: markers are .* the rig says 1\.2 mm"):
        finger.sense(gel_image())


def test_a_touched_reference():
    with pytest.raises(PerceptionError, match="touched or dirty"):
        Finger(SENSOR, linear_gel(), gel_image(0.8e-3, sigma_px=20), FULL)


def test_no_model_and_no_reference():
    with pytest.raises(PerceptionError, match="no gel model"):
        Finger(SENSOR, None, gel_image(), FULL)
    with pytest.raises(PerceptionError, match="untouched gel"):
        Finger(SENSOR, linear_gel(), None, FULL)
    with pytest.raises(PerceptionError, match="the rig says 320×240"):
        Finger(SENSOR, linear_gel(), np.full((480, 640, 3), 90, np.uint8), FULL)
