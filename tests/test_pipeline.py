"""The loop's surroundings."""

import cv2
import pytest

from tiptrace.pipeline import open_tracer
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream


def test_opencv_keeps_to_the_tracers_threads_and_gets_its_own_back() -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with open_tracer(SimulatedStream(make_spec(mode="markers")), "full"):
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 2
        with (
            pytest.raises(RuntimeError, match="in between"),
            open_tracer(SimulatedStream(make_spec(mode="markers")), "full"),
        ):
            raise RuntimeError("in between")
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
