"""An anchoring motion as files: ``plan.csv``, a UR program, ROS poses, and a picture of the alternatives."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from tiptrace.estimation.planning import Prediction, Task
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.geometry.transforms import quaternion_from_rotation, rotation_log
from tiptrace.types import FloatArray

APPROACH_MPS, SETTLE_S = 0.005, 2.0
ABORT_RATIO = 1.5  # of the largest expected force
_POSE_HZ = 10.0


def write_plan(
    folder: Path, chosen: Prediction, task: Task, compared: Sequence[Prediction], picture: bool = True
) -> None:
    """Write a motion into a folder, which is made where it is missing.

    Poses are T_E0_E: the hand relative to where it was at first touch, in the frame of the hand there; m, x, y, z, w.

    Args:
        folder: Gets ``plan.csv``, ``plan.script`` (URScript), ``poses.yaml`` (``geometry_msgs/PoseArray``) and
            ``plan.png``.
        chosen: The motion.
        task: Rig, nominal tip and loads.
        compared: Motions beside each other in the picture.
        picture: Whether to draw it.

    Raises:
        OutputError: a file cannot be written.
    """
    s = np.arange(0.0, chosen.wiggle.duration_s + 0.5 / _POSE_HZ, 1.0 / _POSE_HZ)
    T_E0_E = chosen.wiggle.poses(s, task.tip_E, task.pads_E)
    write_atomic(folder / "plan.csv", _csv(s, T_E0_E))
    write_atomic(folder / "plan.script", _urscript(chosen, task, T_E0_E))
    write_atomic(folder / "poses.yaml", _ros_poses(T_E0_E))
    if picture:
        write_atomic(folder / "plan.png", _picture(compared))


def _csv(s: FloatArray, T: FloatArray) -> str:
    text = io.StringIO()
    rows = np.column_stack([s, T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3])])
    header = "t_s,x_m,y_m,z_m,qx,qy,qz,qw"
    np.savetxt(text, rows, fmt="%.9f", delimiter=",", header=header, comments="")
    return text.getvalue()


def _urscript(p: Prediction, task: Task, T: FloatArray) -> str:
    """A UR program: force-guarded approach, settling, servo through the poses, abort on force."""
    along = task.tip_E - task.pads_E
    x, y, z = APPROACH_MPS * along / np.linalg.norm(along)  # along the tool, as it is held
    lines = [
        "def tiptrace_anchor():",
        f"  local limit = {ABORT_RATIO * p.force_n:.2f}",
        "  thread guard():",
        "    while True:",
        "      if norm(get_tcp_force()) > limit:",
        '        popup("contact force above the limit", "tiptrace", error=True)',
        "        halt",
        "      end",
        "      sync()",
        "    end",
        "  end",
        "  run guard()",
        "  zero_ftsensor()",
        "  local here = get_actual_tcp_pose()",
        f"  local ahead = pose_trans(here, p[{x:.6f}, {y:.6f}, {z:.6f}, 0, 0, 0])",
        f"  while norm(get_tcp_force()) < {task.preload_n:.2f}:",
        "    speedl([ahead[0] - here[0], ahead[1] - here[1], ahead[2] - here[2], 0, 0, 0], 0.05, 0.008)",
        "  end",
        "  stopl(0.5)",
        f"  sleep({SETTLE_S:.1f})",
        "  local start = get_actual_tcp_pose()",
    ]
    for t, w in zip(T[:, :3, 3], rotation_log(T[:, :3, :3]), strict=True):
        v = ", ".join(f"{x:.6f}" for x in np.concatenate([t, w]))
        lines.append(f"  servol_wait(pose_trans(start, p[{v}]))")
    define = [
        "def servol_wait(target):",
        "  local k = 0",
        f"  while k < {round(500 / _POSE_HZ)}:",
        "    servoj(get_inverse_kin(target), t=0.002, lookahead_time=0.1, gain=300)",
        "    k = k + 1",
        "  end",
        "end",
    ]
    return "\n".join([*define, *lines, "  stopj(1.0)", "end", ""])


def _ros_poses(T: FloatArray) -> str:
    """geometry_msgs/PoseArray as YAML, in the frame of the hand at the start."""
    poses = [
        {
            "position": dict(zip("xyz", (round(float(v), 9) for v in t), strict=True)),
            "orientation": dict(zip("xyzw", (round(float(v), 9) for v in q), strict=True)),
        }
        for t, q in zip(T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3]), strict=True)
    ]
    return yaml.safe_dump({"header": {"frame_id": "tool0_at_start"}, "poses": poses}, sort_keys=False)


def _picture(predictions: Sequence[Prediction]) -> bytes:
    """Predicted σ and load of each motion, PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    colours = ("#0072B2", "#E69F00", "#009E73")
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    at = np.arange(len(predictions))
    for k, (axis, colour) in enumerate(zip("xyz", colours, strict=True)):
        value = [min(p.sigma_m[k] * 1e3, 100.0) for p in predictions]
        left.bar(at + 0.27 * (k - 1), value, 0.25, color=colour, label=axis)
    left.axhline(2.0, color="0.4", ls="--", lw=1, label="refused above")
    left.set(yscale="log", ylim=(0.03, 100), ylabel="predicted σ of the tip [mm]")
    right.bar(at, [p.force_n for p in predictions], 0.5, color="#56B4E9")
    right.set(ylabel="largest expected contact force [N]")
    for ax in (left, right):
        ax.set_xticks(at, [p.wiggle.name for p in predictions])
        ax.grid(axis="y", alpha=0.3)
    left.legend(ncols=2, fontsize=9)
    png = io.BytesIO()
    fig.savefig(png, dpi=120)
    plt.close(fig)
    return png.getvalue()
