"""The Python with rclpy, and an environment in which nobody else hears what is said."""

from __future__ import annotations

import os
import random

import pytest

ROS_PYTHON = os.environ.get("TIPTRACE_ROS_PYTHON", "")
NEEDS_ROS = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not ROS_PYTHON, reason="TIPTRACE_ROS_PYTHON names no Python with rclpy (docs/ros2.md)"
    ),
]


def alone() -> dict[str, str]:
    """Environment variables: loopback only, a domain of one's own."""
    return os.environ | {
        "ROS_DOMAIN_ID": str(random.SystemRandom().randint(1, 100)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
