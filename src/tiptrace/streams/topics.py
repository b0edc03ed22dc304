"""Names of the recording format: topics, frames, attachments. See ``docs/data.md``."""

from __future__ import annotations

from typing import Literal

from tiptrace.types import Side

IMAGE_TOPIC: dict[Side, str] = {
    "left": "/tactile/left/image/compressed",
    "right": "/tactile/right/image/compressed",
}
MARKER_TOPIC: dict[Side, str] = {"left": "/tactile/markers/left", "right": "/tactile/markers/right"}
POSE_TOPIC = "/ee_pose"
PHASE_TOPIC = "/trial/phase"
OPENING_TOPIC = "/gripper/opening"
TRUTH_TOPIC = "/ground_truth/tip"

FRAME_ID: dict[Side, str] = {"left": "tactile_left", "right": "tactile_right"}

RIG_FILE = "rig.yaml"
TOOL_FILE = "tool.yaml"
TRIAL_FILE = "trial.yaml"
REFERENCE_FILE: dict[Side, str] = {"left": "reference_left.png", "right": "reference_right.png"}

Stamps = Literal["header", "log", "auto"]
"""Which clock dates a message: its header, the recorder's, or the header's if the two agree."""

NS = 1_000_000_000
