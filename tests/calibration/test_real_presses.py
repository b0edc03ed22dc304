"""Real ball presses, calibrated by the package and held out: the numbers of docs/sensing.md."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="module")
def bench():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "real_presses.py"
    spec = importlib.util.spec_from_file_location("real_presses", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["real_presses"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def presses(bench, shared_data):
    return bench.read(shared_data, 1.5)


def medians(held):
    """Normal error in degrees and |radius error|."""
    return (
        np.median([h.score.normal_error_deg for h in held]),
        np.median([abs(h.score.radius_error) for h in held]),
    )


@pytest.mark.parametrize("group", ["largest", pytest.param("smallest", marks=pytest.mark.slow)])
def test_the_extreme_presses_from_the_others(bench, presses, group):
    folder, blob_px = presses
    order = np.argsort(blob_px, kind="stable").tolist()
    held = bench.hold_out(folder, order[-6:] if group == "largest" else order[:6], seed=0)
    normal_deg, radius = medians(held)
    assert normal_deg <= 5.0
    assert radius <= 0.05


@pytest.mark.slow
def test_each_press_from_all_others(bench, presses):
    folder, _ = presses
    held = [bench.hold_out(folder, [i], seed=i)[0] for i in range(len(folder.presses))]
    normal_deg, radius = medians(held)
    assert len(held) == 24
    assert normal_deg <= 5.0
    assert radius <= 0.05
