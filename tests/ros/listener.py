"""``Ros2Robot`` for some seconds, and what it gave: python listener.py URI OUT.json."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from tiptrace.drivers.ros2 import Ros2Robot
from tiptrace.drivers.timeline import Timeline
from tiptrace.errors import TipTraceError
from tiptrace.types import OpeningSample, PhaseSample, PoseSample

SECONDS = 4.0


def main(uri: str, out: Path) -> None:
    timeline = Timeline()
    found: dict = {"poses": [], "openings": [], "phases": [], "error": ""}
    try:
        with Ros2Robot(uri, timeline) as robot:
            robot.start(lambda: None)
            ends = time.monotonic() + SECONDS
            while time.monotonic() < ends:
                time.sleep(0.05)
                for sample in robot.take():
                    if isinstance(sample, PoseSample):
                        found["poses"].append([sample.stamp_ns, *sample.T_B_E.ravel().tolist()])
                    elif isinstance(sample, OpeningSample):
                        found["openings"].append(sample.opening_m)
                    elif isinstance(sample, PhaseSample):
                        found["phases"].append(sample.phase.value)
            health = robot.health()
            found |= {"frames": [robot.frames.base, robot.frames.end_effector], "faults": dict(health.faults)}
    except TipTraceError as error:
        found["error"] = str(error)
    out.write_text(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
