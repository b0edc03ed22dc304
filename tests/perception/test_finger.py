import numpy as np
import pytest

from tiptrace.config import Sensor, Transform
from tiptrace.errors import PerceptionError
from tiptrace.perception.finger import Finger
from tiptrace.perception.settings import SensingConfig

from .gel_images import S_M, H, W, bump, grid, linear_gel, paint_dots, shade, to_uint8

PAPER = SensingConfig(method="paper")
SENSOR = Sensor(
    mm_per_px=(S_M * 1e3, S_M * 1e3),
    T_E_S=Transform(translation_m=(0, 0, 0.14), quaternion_xyzw=(0, 0, 0, 1)),
)


def gel_image(depth_m=0.0, shift=(0.0, 0.0), sigma_px=40.0):
    _, p, q = bump(depth_m, sigma_px)
    return to_uint8(paint_dots(shade(p, q), grid() + shift, 10))


def test_untouched_gel_is_at_zero():
    finger = Finger(SENSOR, linear_gel(), gel_image(), PAPER)
    markers = finger.sense(gel_image())
    assert np.abs(markers.x_S[:, 2]).max() < 1e-6
    assert np.abs(finger.depth_m).max() < 1e-6
    assert markers.tracked.all()
    assert finger.depth.zero_visible


@pytest.mark.parametrize("depth_m", [0.2e-3, 0.8e-3])
def test_a_press_is_metric_and_its_surroundings_stay_at_zero(depth_m):
    finger = Finger(SENSOR, linear_gel(), gel_image(), PAPER)
    finger.sense(gel_image())
    markers = finger.sense(gel_image(depth_m, (1.5, -0.8), sigma_px=25))
    z, _, _ = bump(depth_m, 25)
    depth = finger.depth_m
    assert depth.dtype == np.float32
    assert depth.shape == (H, W)
    assert depth.max() == pytest.approx(depth_m, rel=0.05)
    assert np.sqrt(np.mean((depth + z) ** 2)) < 17e-6  # what the nearest fill under dots costs
    assert np.abs(depth[:, 280:]).mean() < 10e-6
    truth = grid() + np.array([1.5, -0.8])
    x_true = (truth - [(W - 1) / 2, (H - 1) / 2]) * S_M
    distance = np.linalg.norm(markers.x_S[:, None, :2] - x_true[None], axis=2)
    assert sorted(distance.argmin(axis=1)) == list(range(len(truth)))
    assert distance.min(axis=1).max() < 0.3 * S_M


def test_rows_keep_their_identity():
    finger = Finger(SENSOR, linear_gel(), gel_image(), PAPER)
    first = finger.sense(gel_image())
    for t in range(1, 6):
        last = finger.sense(gel_image(shift=(8.0 * t, 0)))
    assert last.x_S.shape == first.x_S.shape == (len(finger.markers), 3)
    assert not last.tracked.all()
    assert np.isnan(last.x_S[~last.tracked]).all()
    assert np.isnan(last.uv_px[~last.tracked]).all()
    kept = last.tracked & (first.uv_px[:, 0] < 270)
    np.testing.assert_allclose(
        last.uv_px[kept] - first.uv_px[kept], np.tile([40, 0], (kept.sum(), 1)), atol=0.6
    )


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((H, W, 3), np.uint8), "black"),
        (np.full((H, W, 3), 255, np.uint8), "overexposed"),
        (np.full((480, 640, 3), 90, np.uint8), "the rig says 320×240"),
        (to_uint8(shade(), noise=1.0), "markers, need at least 11"),
    ],
)
def test_bad_images_are_refused(image, message):
    finger = Finger(SENSOR, linear_gel(), gel_image(), PAPER)
    with pytest.raises(PerceptionError, match=message):
        finger.sense(image)


def test_the_message_names_the_finger():
    finger = Finger(SENSOR, linear_gel(), gel_image(), PAPER, side="left")
    with pytest.raises(PerceptionError, match=r"^left finger: tactile image is black"):
        finger.sense(np.zeros((H, W, 3), np.uint8))


def test_without_reference():
    with pytest.raises(PerceptionError, match="untouched gel"):
        Finger(SENSOR, linear_gel(), None, PAPER)
