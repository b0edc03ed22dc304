"""``tiptrace plan-anchor``: the whole of Stage I as a plan, with what it will tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.estimation.planning import Prediction, Task
    from tiptrace.types import FloatArray

_POSE_HZ = 10.0
_APPROACH_MPS, _SETTLE_S = 0.005, 2.0


def plan_anchor(
    rig: Annotated[Path, typer.Option(help="rig.yaml.")],
    tool: Annotated[Path, typer.Option(help="tool.yaml with the nominal tip.")],
    out: Annotated[
        Path, typer.Option(help="Folder for plan.csv, plan.script, poses.yaml and plan.png.")
    ] = Path("anchor-plan"),
    motion: Annotated[str, typer.Option(help="Which alternative to export; see the table.")] = "recommended",
    preload: Annotated[float, typer.Option(help="Contact force after pressing down, N.")] = 3.0,
    picture: Annotated[bool, typer.Option(help="Draw plan.png.")] = True,
) -> None:
    """Propose the anchoring motion: approach, preload, settling, waypoints, loads, and the accuracy to expect.

    Poses are relative to the hand at first touch (T_E0_E): start with the tip on the surface, then press.

    Examples:

      tiptrace plan-anchor --rig rig.yaml --tool tool.yaml

      tiptrace plan-anchor --rig rig.yaml --tool tool.yaml --motion gentle --out plan
    """
    import numpy as np
    from rich.console import Console

    from tiptrace.config import Rig, Tool, load_yaml
    from tiptrace.errors import ConfigError
    from tiptrace.estimation.planning import CANDIDATES, Task, predict
    from tiptrace.estimation.priors import require_tip

    names = [w.name for w in CANDIDATES]
    if motion not in names:
        raise ConfigError(f"unknown anchoring motion '{motion}'; valid: {', '.join(names)}")
    prior = require_tip(load_yaml(Tool, tool))
    sigma = float(np.sqrt(np.trace(prior.covariance) / 3.0))
    task = Task(load_yaml(Rig, rig), prior.c, sigma, preload)
    predictions = [predict(w, task) for w in CANDIDATES]
    chosen = predictions[names.index(motion)]
    out.mkdir(parents=True, exist_ok=True)
    s = np.arange(0.0, chosen.wiggle.duration_s + 0.5 / _POSE_HZ, 1.0 / _POSE_HZ)
    T_E0_E = chosen.wiggle.poses(s, task.tip_E, task.pads_E)
    _write_csv(out / "plan.csv", s, T_E0_E)
    (out / "plan.script").write_text(_urscript(chosen, task, T_E0_E))
    (out / "poses.yaml").write_text(_ros_poses(s, T_E0_E))
    if picture:
        _draw(out / "plan.png", predictions)
    console = Console()
    console.print(_table(predictions, motion))
    for line in (
        f"Approach along the tool at {_APPROACH_MPS * 1e3:.0f} mm/s until {preload:.1f} N, settle {_SETTLE_S:.0f} s,",
        f"then {chosen.wiggle.name} for {chosen.wiggle.duration_s:.0f} s.",
        f"Expected force up to {chosen.force_n:.1f} N, abort above {1.5 * chosen.force_n:.1f} N. Written to {out}",
    ):
        console.print(line, highlight=False, soft_wrap=True)


def _table(predictions: list[Prediction], motion: str) -> object:
    from rich.table import Table

    table = Table(title="Anchoring motions: standard deviation of the tip along the hand's start axes")
    for column in ("motion", "σx mm", "σy mm", "σz mm", "force N", "gel shear mm", "speed mm/s", "remark"):
        table.add_column(
            column, justify="left" if column in ("motion", "remark") else "right", no_wrap=column == "motion"
        )
    for p in predictions:
        sigma = [f"{v * 1e3:.2f}" if v < 0.05 else "open" for v in p.sigma_m]
        remark = (
            "tip unobservable"
            if p.worst_sigma_m > 2e-3
            else ("" if p.within_strain else "beyond the gel's limit")
        )
        name = f"[bold]{p.wiggle.name}[/]" if p.wiggle.name == motion else p.wiggle.name
        loads = (f"{p.force_n:.1f}", f"{p.pad_shear_m * 1e3:.2f}", f"{p.speed_mps * 1e3:.0f}")
        table.add_row(name, *sigma, *loads, remark)
    return table


def _write_csv(path: Path, s: FloatArray, T: FloatArray) -> None:
    import numpy as np

    from tiptrace.geometry.transforms import quaternion_from_rotation

    rows = np.column_stack([s, T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3])])
    header = "t_s,x_m,y_m,z_m,qx,qy,qz,qw"
    np.savetxt(path, rows, fmt="%.9f", delimiter=",", header=header, comments="")


def _urscript(p: Prediction, task: Task, T: FloatArray) -> str:
    """A UR program: force-guarded approach, settling, servo through the poses, abort on force."""
    import numpy as np

    from tiptrace.geometry.transforms import rotation_log

    along = task.tip_E - task.pads_E
    x, y, z = _APPROACH_MPS * along / np.linalg.norm(along)  # along the tool, as it is held
    lines = [
        "def tiptrace_anchor():",
        f"  local limit = {1.5 * p.force_n:.2f}",
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
        f"  sleep({_SETTLE_S:.1f})",
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


def _ros_poses(s: FloatArray, T: FloatArray) -> str:
    """geometry_msgs/PoseArray as YAML, in the frame of the hand at the start."""
    import yaml

    from tiptrace.geometry.transforms import quaternion_from_rotation

    poses = [
        {
            "position": dict(zip("xyz", (round(float(v), 9) for v in t), strict=True)),
            "orientation": dict(zip("xyzw", (round(float(v), 9) for v in q), strict=True)),
        }
        for t, q in zip(T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3]), strict=True)
    ]
    return yaml.safe_dump({"header": {"frame_id": "tool0_at_start"}, "poses": poses}, sort_keys=False)


def _draw(path: Path, predictions: list[Prediction]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

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
    fig.savefig(path, dpi=120)
    plt.close(fig)
