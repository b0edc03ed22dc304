"""How honest the uncertainties of `tiptrace surface` are: synthetic traces with known truth.

python benchmarks/evaluation_surface.py --seeds 60
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.evaluation.test_surface_fits import groove

from tiptrace.evaluation.surface_centreline import fit_centreline
from tiptrace.evaluation.surface_periodic import fit_periodic
from tiptrace.evaluation.surface_plane import fit_plane

PERIOD, AMPLITUDE = 0.05, 4e-3


def band_coverage(traces: int, phi: float, seeds: int) -> float:
    """Part of the curve inside the 95 % band of its shape, after the anchors' common offset is taken out."""
    held = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        data = [groove(rng, sigma=3e-4, phi=phi)[:, :2] for _ in range(traces)]
        fit = fit_centreline(data, periodic=fit_periodic(data))
        assert fit is not None
        offsets = []
        for shift in np.linspace(-5e-3, 5e-3, 401):
            error = fit.across_m - AMPLITUDE * np.sin(2 * np.pi * (fit.along_m - shift) / PERIOD)
            offsets.append(error - error.mean())
        best = min(offsets, key=lambda o: float(np.sum(o**2)))
        held.append(np.mean(np.abs(best) <= 1.96 * fit.std_m))
    return float(np.mean(held))


def scores(traces: int, phi: float, seeds: int) -> tuple[float, float, float]:
    """RMS of error over claimed standard deviation: period, amplitude, slope along the travel; 1 is right."""
    z = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        data = [groove(rng, sigma=3e-4, phi=phi) for _ in range(traces)]
        p, plane = fit_periodic([d[:, :2] for d in data]), fit_plane(data)
        if p is None:
            continue
        z.append(
            [
                (p.period_m - PERIOD) / p.period_std_m,
                (p.amplitude_m - AMPLITUDE) / p.amplitude_std_m,
                plane.axes_B[0][2] / plane.tilt_along_std_rad,
            ]
        )
    period, amplitude, slope = np.sqrt(np.mean(np.square(z), axis=0))
    return float(period), float(amplitude), float(slope)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=60)
    seeds = parser.parse_args().seeds
    print("traces  serial  band coverage  rms z: period  amplitude  slope")
    for traces in (1, 5):
        for phi in (0.0, 0.8, 0.95):
            z = scores(traces, phi, seeds)
            print(
                f"{traces:6d}  {phi:6.2f}  {band_coverage(traces, phi, seeds):13.2f}  "
                + "  ".join(f"{v:9.2f}" for v in z)
            )


if __name__ == "__main__":
    main()
