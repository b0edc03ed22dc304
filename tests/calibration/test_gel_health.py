import cv2
import numpy as np
import pytest

from tiptrace.calibration.gel_health import check_gel
from tiptrace.errors import CalibrationError
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.presses import render_press
from tiptrace.sim.render import TactileRenderer


@pytest.fixture(scope="module")
def gel_and_reference(trained):
    """A gel model, the renderer of a marker gel, its reference and one fresh image."""
    from tiptrace.sim.gel import untouched

    renderer = TactileRenderer(layout=DotLayout(), seed=9)
    return load_gel_model(trained[2].model), renderer, renderer.reference(), renderer.render(untouched(), 4)


def brightened(image, gain):
    return np.clip(image * np.asarray(gain), 0, 255).astype(np.uint8)


def scratched(image, renderer):
    line = cv2.line(np.zeros(image.shape[:2], np.float32), (60, 60), (130, 160), 1.0, 2, cv2.LINE_AA)
    return brightened(image, 1 + 0.3 * cv2.GaussianBlur(line, (0, 0), 0.8)[..., None] * [1, 0.3, -0.6])


def dented(image, renderer):
    from tiptrace.sim.gel import GEL_GRID, PadContact, deform

    X, Y = GEL_GRID.mesh()
    none = np.zeros((0, 2))
    dent = 0.1e-3 - 0.02 * np.maximum(np.hypot(X, Y) - 2e-3, 0)
    return renderer.render(deform(PadContact(dent, none, none)), 6)


def inner_dots(renderer):
    from tiptrace.sim.gel import untouched

    dots = renderer.dot_truth(untouched()).uv_px
    return dots[(np.abs(dots - [160, 120]) < [70, 60]).all(axis=1)]


def dotless(image, renderer):
    for u, v in inner_dots(renderer)[:3]:
        spot = cv2.circle(np.zeros(image.shape[:2], np.uint8), (round(u), round(v)), 9, 255, -1)
        image = cv2.inpaint(image, spot, 3, cv2.INPAINT_TELEA)
    return image


def smudged(image, renderer):
    dots, image = inner_dots(renderer), image.copy()
    near = np.linalg.norm(dots - dots[0], axis=1)
    a, b = dots[0], dots[np.argsort(near)[1]]
    cv2.line(image, (round(a[0]), round(a[1])), (round(b[0]), round(b[1])), (28, 24, 24), 8, cv2.LINE_AA)
    return image


def shifted(image, renderer):
    move = np.array([[1, 0, 1.5], [0, 1, 0]])
    return cv2.warpAffine(image, move, (320, 240), borderMode=cv2.BORDER_REPLICATE)


DAMAGE = {
    "nothing": (lambda image, _: image, set()),
    "lamps dimmed": (lambda image, _: brightened(image, 0.8), {"illumination_change"}),
    "one lamp dimmed": (lambda image, _: brightened(image, [0.9, 1, 1]), {"illumination_change"}),
    "scratch": (scratched, {"curl_per_mm"}),
    "dent": (dented, {"flatness_um"}),
    "dots gone": (dotless, {"dots_lost"}),
    "dots merged": (smudged, {"dots_merged"}),
    "gel shifted": (shifted, {"dots_moved_px"}),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_each_health_score_tells_its_own_damage_and_no_other(name, gel_and_reference):
    gel, renderer, reference, fresh = gel_and_reference
    damage, expected = DAMAGE[name]
    (health,) = check_gel([damage(fresh, renderer)], reference, gel, (62.5e-6, 62.5e-6))
    assert not health.touched
    told = {score for score, verdict in health.verdicts().items() if verdict != "good"}
    assert told == expected


def test_health_in_numbers(gel_and_reference):
    gel, renderer, reference, fresh = gel_and_reference
    s = (62.5e-6, 62.5e-6)
    dim, gone, merged = check_gel(
        [brightened(fresh, 0.8), dotless(fresh, renderer), smudged(fresh, renderer)], reference, gel, s
    )
    assert dim.illumination_change == pytest.approx(0.2, abs=0.03)
    assert gone.dots_lost == 3
    assert (merged.dots_merged, merged.dots_lost) == (1, 0)
    with pytest.raises(CalibrationError, match="no image"):
        check_gel([], reference, gel, s)
    with pytest.raises(CalibrationError, match="the reference 320×240"):
        check_gel([np.full((480, 640, 3), 90, np.uint8)], reference, gel, s)


def test_a_contact_is_no_damage(gel_and_reference):
    gel, renderer, reference, _ = gel_and_reference
    press = render_press(renderer, (150.0, 110.0), 6e-3, 0.8e-3).image
    good, wrong = check_gel([press, press[..., ::-1].copy()], reference, gel, (62.5e-6, 62.5e-6))
    assert good.touched
    assert np.isnan(good.dots_moved_px)
    assert set(good.verdicts().values()) == {"good"}
    assert wrong.illumination_change > 0.1


def test_a_network_that_no_longer_fits_shows_as_curl_in_the_contact(trained):
    """The same press with the lamps of another arrangement: slopes that no surface has."""
    gel = load_gel_model(trained[2].model)
    renderer = TactileRenderer(seed=9)
    reference = renderer.reference()
    press = render_press(renderer, (150.0, 110.0), 6e-3, 0.8e-3).image
    ratio = press / np.maximum(reference.astype(float), 1)
    turned = brightened(reference, ratio[..., [1, 2, 0]])
    good, wrong = check_gel([press, turned], reference, gel, (62.5e-6, 62.5e-6))
    assert good.verdicts()["curl_in_contact"] == "good"
    assert wrong.verdicts()["curl_in_contact"] == "worn"
