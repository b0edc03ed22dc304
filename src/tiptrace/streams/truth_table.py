"""The truth of a simulated trial, frame by frame, as a table (Parquet)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.errors import MissingExtraError, RecordingError
from tiptrace.geometry.transforms import invert, quaternion_from_rotation, rotation_log
from tiptrace.sim.simulation import START_NS, Frame
from tiptrace.types import FloatArray


class TruthTable:
    """Collects one row per frame.

    Columns (SI, base frame unless the name says otherwise): ``frame, exposure_ns, phase, tip_B_m (3), T_B_E (7),
    T_B_T (7), grasp_motion_rotvec_rad (3), grasp_motion_m (3)`` (motion of the tool in F_E since frame 0),
    ``contact_force_B_n (3), contact_normal_n, in_contact, contact_where, tip_slipping, penetration_m,
    grip_left_n, grip_right_n, slipping_nodes, contact_nodes, slip_deg, slip_m, grasp_slipping,
    force_residual_n, moment_residual_nm, retried, delivered, stamp_left_ns, stamp_right_ns,
    markers_left_S_m (n·3), markers_right_S_m (n·3)``. Poses are x, y, z, qx, qy, qz, qw.
    """

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._T_E_T_0: FloatArray | None = None

    def add(self, frame: Frame) -> None:
        """Add a frame."""
        s = frame.state
        if self._T_E_T_0 is None:
            self._T_E_T_0 = s.T_E_T
        motion = s.T_E_T @ invert(self._T_E_T_0)
        k = len(s.pads.normal_n) // 2
        exposure = START_NS + round(s.t_s * 1e9)
        row = {
            "frame": s.index,
            "exposure_ns": exposure,
            "phase": s.phase.value,
            "tip_B_m": s.tip_B.tolist(),
            "T_B_E": _pose(s.T_B_E),
            "T_B_T": _pose(s.T_B_E @ s.T_E_T),
            "grasp_motion_rotvec_rad": rotation_log(motion[:3, :3]).tolist(),
            "grasp_motion_m": motion[:3, 3].tolist(),
            "contact_force_B_n": s.tip.force.tolist(),
            "contact_normal_n": s.tip.normal_n,
            "in_contact": s.in_contact,
            "contact_where": s.tip.where,
            "tip_slipping": s.tip.slipping,
            "penetration_m": s.tip.penetration_m,
            "grip_left_n": float(s.pads.normal_n[:k].sum()),
            "grip_right_n": float(s.pads.normal_n[k:].sum()),
            "slipping_nodes": int(s.pads.slipping.sum()),
            "contact_nodes": int((s.pads.normal_n > 0).sum()),
            "slip_deg": s.slip_deg,
            "slip_m": s.slip_m,
            "grasp_slipping": s.creeping,
            "force_residual_n": s.force_residual_n,
            "moment_residual_nm": s.moment_residual_nm,
            "retried": s.retried,
            "delivered": bool(frame.stamps_ns),
        }
        for side in ("left", "right"):
            row[f"stamp_{side}_ns"] = frame.stamps_ns.get(side)
            row[f"markers_{side}_S_m"] = frame.markers_S[side].ravel().tolist()
        self.rows.append(row)

    def column(self, name: str) -> np.ndarray:
        """One column as an array."""
        return np.array([row[name] for row in self.rows])

    def write(self, path: Path) -> None:
        """Write the table; the file appears only when it is complete.

        Raises:
            MissingExtraError: pyarrow is not installed.
            RecordingError: the file cannot be written.
        """
        try:
            import pyarrow as pa
            import pyarrow.parquet as pq
        except ImportError:
            raise MissingExtraError("pyarrow", "tables") from None
        partial = path.with_name(f"{path.name}.partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.Table.from_pylist(self.rows), partial)
            os.replace(partial, path)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written ({error.strerror})") from None


def _pose(T: FloatArray) -> list[float]:
    return [*T[:3, 3].tolist(), *quaternion_from_rotation(T[:3, :3]).tolist()]
