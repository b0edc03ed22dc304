"""After warming up, no image makes the chain compile anything."""

import sys

import numpy as np
import pytest

from tiptrace.perception.finger import Finger
from tiptrace.perception.settings import SensingConfig
from tiptrace.perception.warm_up import warm_up

from .gel_images import linear_gel
from .test_full_chain import SENSOR, gel_image


def compiled_kinds() -> int:
    """Kinds of arguments that any compiled function was made for."""
    modules = [m for name, m in list(sys.modules.items()) if name.startswith("tiptrace.perception.")]
    functions = {f for m in modules for f in vars(m).values() if hasattr(f, "nopython_signatures")}
    return sum(len(f.nopython_signatures) for f in functions)


@pytest.mark.parametrize("method", ["full", "paper"])
@pytest.mark.parametrize("writeable", [True, False])
def test_the_first_image_waits_for_nothing(method, writeable):
    warm_up()
    before = compiled_kinds()
    assert before > 15
    finger = Finger(SENSOR, linear_gel(), gel_image(), SensingConfig(method=method))
    for shift in (0.0, 1.0):
        image = np.ascontiguousarray(gel_image(0.5e-3, (shift, 0.0)))
        image.setflags(write=writeable)
        finger.sense(image)
    assert finger.depth_m is not None
    assert compiled_kinds() == before
