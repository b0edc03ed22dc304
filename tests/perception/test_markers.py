import numpy as np
import pytest

from tiptrace.errors import PerceptionError
from tiptrace.perception.markers import check_image, detect_markers

from .gel_images import H, W, grid, paint_dots, shade, to_uint8


def vignette(image):
    """Corners darker than the dots in the middle."""
    v, u = np.indices(image.shape[:2])
    r2 = ((u / image.shape[1] - 0.5) ** 2 + (v / image.shape[0] - 0.5) ** 2) / 0.5
    return image * (1.0 - 0.75 * r2)[..., None]


def match(found, truth):
    """Distance from each true dot to the nearest found one."""
    return np.linalg.norm(found[None] - truth[:, None], axis=2).min(axis=1)


@pytest.mark.parametrize("diameter", [4, 6, 10, 14, 20])
def test_dots_of_any_size_under_a_vignette(diameter):
    truth = grid()
    image = to_uint8(vignette(paint_dots(shade(), truth, diameter)), noise=1.8)
    markers = detect_markers(image)
    assert len(markers) == len(truth)
    error = match(markers.uv_px, truth)
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.median(markers.diameter_px) == pytest.approx(diameter, abs=1.3)


@pytest.mark.parametrize(("pitch", "diameter"), [(14, 5), (22, 8), (33, 18), (45, 12)])
def test_any_grid(pitch, diameter):
    truth = grid(pitch)
    markers = detect_markers(to_uint8(paint_dots(shade(), truth, diameter), noise=1.5))
    assert len(markers) == len(truth)
    assert match(markers.uv_px, truth).max() < 0.3


def test_irregular_dots_glints_dirt_and_a_broken_dot():
    rng = np.random.default_rng(1)
    truth = grid() + rng.uniform(-4, 4, grid().shape)
    image = paint_dots(shade(), truth, 11)
    image = paint_dots(image, truth[::3] + 1.0, 3.5, level=110)  # glints
    u, v = truth[20].round().astype(int)
    image[v - 1 : v + 1, u - 7 : u + 8] = image[0, 0]  # a dot broken by a scratch across it
    image = paint_dots(image, truth[5:9] + np.array([15.0, 3.0]), 2.5, level=60)  # specks of dirt
    markers = detect_markers(to_uint8(image, noise=1.5))
    assert len(markers) == len(truth)
    assert match(markers.uv_px, truth).max() < 0.6


def test_dots_cut_by_the_border_are_left_out():
    truth = grid()
    cut = np.array([[100.0, 1.0], [318.0, 60.0], [0.0, 90.0]])
    markers = detect_markers(to_uint8(paint_dots(shade(), np.vstack([truth, cut]), 10)))
    assert len(markers) == len(truth)


def test_twice_the_size():
    image = np.tile(shade()[:1, :1], (480, 640, 1))
    truth = grid(62, (640, 480), 30)
    markers = detect_markers(to_uint8(paint_dots(image, truth, 21), noise=1.5))
    assert len(markers) == len(truth)


def test_no_markers_or_too_few():
    with pytest.raises(PerceptionError, match="found 0 markers, need at least 11"):
        detect_markers(to_uint8(vignette(shade()), noise=2.0))
    with pytest.raises(PerceptionError, match="found 10 markers"):
        detect_markers(to_uint8(paint_dots(shade(), grid()[20:30])))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((H, W, 3), np.uint8), "black"),
        (np.full((H, W, 3), 255, np.uint8), "overexposed"),
        (np.zeros((H, W), np.uint8), "must be"),
        (np.zeros((H, W, 3), np.float32), "must be"),
        (np.full((480, 640, 3), 99, np.uint8), "640×480 px, the rig says 320×240"),
    ],
)
def test_unusable_images_are_refused(image, message):
    with pytest.raises(PerceptionError, match=message):
        check_image(image, (W, H))


def test_real_gel(shared_data):
    import cv2

    video = cv2.VideoCapture(str(shared_data / "gelsight_mini_marker_video" / "mini_example.avi"))
    _, image = video.read()
    assert len(detect_markers(image)) == 70
