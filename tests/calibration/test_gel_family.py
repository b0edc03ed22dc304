import numpy as np
import pytest

from tiptrace.calibration.gel_family import train_family
from tiptrace.calibration.gel_shading import fit_change, fit_shading
from tiptrace.errors import CalibrationError
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.sim.optics import gel_optics
from tiptrace.sim.presses import render_press
from tiptrace.sim.render import TactileRenderer

from .gel_presses import MM_PER_PX, write


def presses_of(lamp, n=4000, seed=0):
    """Slopes, places, colours and background of gel whose colour grows linearly with the slope, lamp (3, 2)."""
    rng = np.random.default_rng(seed)
    slopes, background = rng.uniform(-0.6, 0.6, (n, 2)), rng.uniform(60, 120, (n, 3))
    normal = slopes / np.sqrt(1 + np.sum(slopes**2, axis=1, keepdims=True))
    return slopes, rng.uniform(size=(n, 2)), background * (1 + normal @ lamp.T), background


def test_a_gels_own_change_is_found_beside_what_is_known():
    mean = np.array([[0.5, 0.1], [0.0, 0.4], [-0.3, -0.3]])
    known = fit_shading(*presses_of(mean))
    same, other = presses_of(mean, seed=1), presses_of(1.1 * mean, seed=1)
    slopes, places = other[:2]
    for presses, expected in ((same, 0.0), (other, 0.1)):
        own = type(known)(fit_change(known, *presses), known.place_degree, known.sigma, known.max_slope)
        change = own.ratio_change(slopes, places)
        light = known.ratio_change(slopes, places)
        assert np.sum(change * light) / np.sum(light * light) == pytest.approx(expected, abs=0.01)


def test_too_few_gels_or_presses_of_each_are_refused(tmp_path):
    write(tmp_path, columns=4, rows=3)
    for gels in (2, 6):
        with pytest.raises(CalibrationError, match="3 gels or more and 7 presses of each"):
            train_family(tmp_path, tmp_path / "gel.onnx", gels, mm_per_px=MM_PER_PX)


def test_the_packaged_network_measures_gels_that_it_was_not_made_on():
    model = load_gel_model("gelsight-mini-virtual")
    shares = []
    for seed in (21, 22, 24, 25, 26):
        renderer = TactileRenderer(gel_optics(seed), seed=seed)
        press = render_press(renderer, (150.0, 115.0), 8e-3, 1e-3)
        chain = FullDepth(model, renderer.reference(), renderer.metres_per_px)
        depth = chain(press.image, np.zeros(chain.shape, dtype=np.bool_), np.zeros((0, 2)))
        shares.append(float(depth.depth_m[47:68, 65:86].max()) / 1e-3)
    assert np.abs(np.array(shares) - 1).max() < 0.12
    assert np.mean(shares) == pytest.approx(1.0, abs=0.05)
