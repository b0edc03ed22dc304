"""The same without a file: a stream of your own, one pair at a time, as a live system would run it.

Anything that has a rig, references and gel models and yields samples is a stream. Here it is the virtual rig with
3-D markers in place of images, which needs no gel model.
"""

import numpy as np

from tiptrace.sim.spec import TrialSpec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.synchronise import synchronise
from tiptrace.tracer import make_tracer
from tiptrace.types import Status

stream = SimulatedStream(TrialSpec(mode="markers", travel_m=0.05))
tracer = make_tracer(stream, method="paper")
for observation in synchronise(stream):  # pairs both fingers, interpolates the pose
    estimate = tracer.update(observation)
    if estimate.status is Status.OK and estimate.p_B is not None:
        x, y, z = np.round(estimate.p_B * 1e3, 2)
        print(f"{estimate.stamp_ns / 1e9:8.3f} s   tip at {x:8.2f} {y:8.2f} {z:8.2f} mm")
