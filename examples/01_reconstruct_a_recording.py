"""Trace a recording and look at the result: python examples/01_reconstruct_a_recording.py trial.mcap"""

import sys
from pathlib import Path

from tiptrace.evaluation.metrics import evaluate
from tiptrace.pipeline import open_tracer, trace
from tiptrace.streams.recording import Recording

recording = Recording(Path(sys.argv[1]))
with open_tracer(recording, method="paper") as tracer:
    trajectory = trace(recording, tracer)

assert trajectory.anchor is not None
print("Stage I, p_B(0) [m]:", trajectory.anchor.p_B)
print("last tip [m]:       ", trajectory.estimates[-1].p_B)
metrics = evaluate(trajectory, recording.truth())  # NaN where the recording holds no ground truth
print(f"trajectory RMSE {metrics.trajectory_rmse_mm:.2f} mm at {metrics.loop_rate_hz.mean:.0f} Hz")
