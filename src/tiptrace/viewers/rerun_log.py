"""A trial in Rerun (extra ``viz``): images, depth, scene, uncertainty, plots and events, laid out without a click."""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tiptrace.config import Rig
from tiptrace.errors import MissingExtraError, OutputError
from tiptrace.snapshot import Snapshot
from tiptrace.types import SIDES, FloatArray, Side, TipTrajectory, TruthSample
from tiptrace.viewers.rerun_blueprint import MAGNIFIED, blueprint

_BLUE, _RED, _GREEN, _GREY = (0, 114, 178), (213, 94, 0), (0, 158, 115), (150, 150, 150)
_AXES = ((213, 94, 0), (0, 158, 115), (0, 114, 178))  # x, y, z
_PAD_HALF_M = (0.010, 0.0075, 0.002)
_ARROWS = 3.0  # marker motion is drawn larger than it is
_START_S = 10.0


class WithDepth(Protocol):
    """A finger that keeps its last depth map."""

    @property
    def depth_m(self) -> Any:
        """(h, w) m, None before the first."""
        ...


class RerunLog:
    """Logs snapshots.

    Args:
        name: Of the trial.
        rig: For the gripper's pads; without it the scene has none.
        truth: True tip, where there is one.

    Raises:
        MissingExtraError: Rerun is not installed.
    """

    def __init__(self, name: str, rig: Rig | None = None, truth: Sequence[TruthSample] = ()) -> None:
        try:
            import rerun
        except ImportError:
            raise MissingExtraError("rerun-sdk", "viz") from None
        self._rr: Any = rerun
        self._rig = rig
        self._log: Any = rerun.RecordingStream("tiptrace")
        self._log.send_recording_name(name)
        self._path: list[FloatArray] = []
        self._logged, self._events, self._status = 0, 0, ""
        self.depth_of: Mapping[Side, WithDepth] = {}
        self._truth = [sample.p_B for sample in truth]
        self._viewer: subprocess.Popen[bytes] | None = None

    def save(self, path: Path) -> None:
        """Write to a file from now on.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
        self._log.save(str(path), default_blueprint=blueprint())
        self._static()

    def spawn(self) -> None:
        """Open a viewer that listens on this machine only, and send it everything from now on.

        Raises:
            OutputError: the viewer does not start (no display?).
        """
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port)]
        with tempfile.TemporaryFile() as said:
            self._viewer = subprocess.Popen(
                [*command, "--hide-welcome-screen", "--expect-data-soon"], stdout=said, stderr=said
            )
            self._await(port, said)
        self._log.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint())
        self._static()

    def _await(self, port: int, said: Any) -> None:
        assert self._viewer is not None
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._viewer.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.1)
        self._viewer.kill()
        said.seek(0)
        reason = (said.read().decode(errors="replace").strip().splitlines() or ["no answer"])[-1]
        raise OutputError(
            f"Rerun's viewer does not start ({reason[:200]}); write a file with --save, or use --page"
        )

    # --- logging -------------------------------------------------------------------------------------------

    def show(self, snapshot: Snapshot) -> None:
        """Log one pair."""
        estimate = snapshot.estimate
        self._log.set_time("time", timestamp=np.datetime64(estimate.stamp_ns, "ns"))
        for side in SIDES:
            self._gel(side, snapshot)
        self._scene(snapshot)
        self._plots(snapshot)
        if estimate.status.value != self._status:
            self._status = estimate.status.value
            self._text(f"status: {self._status}", "INFO")
        if len(self._path) >= 5 + 1.05 * self._logged:
            self._log_path()

    def finish(self, trajectory: TipTrajectory) -> None:
        """Log what is known at the end: the whole trajectory and the events, at their time."""
        self._log_path()
        for event in trajectory.events:
            self._log.set_time("time", timestamp=np.datetime64(event.start_ns, "ns"))
            self._text(f"{event.kind}: {event.detail}", "WARN")
        self._log.flush()

    def _static(self) -> None:
        rr = self._rr
        unit = np.eye(3) * 0.1
        self._log.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        axes = rr.Arrows3D(vectors=unit, colors=_AXES, radii=0.001, labels=["x", "y", "z"], show_labels=True)
        self._log.log("world/base", axes, static=True)
        if self._truth:
            line = rr.LineStrips3D([np.array(self._truth)], colors=_GREY, radii=0.0002)
            self._log.log("world/truth", line, static=True)
        if self._rig is not None:
            for side in SIDES:
                T = self._rig.T_E_S(side)
                pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
                self._log.log(f"world/hand/{side}", pose, static=True)
                box = rr.Boxes3D(
                    half_sizes=[_PAD_HALF_M], centers=[[0, 0, -_PAD_HALF_M[2]]], colors=_GREY, labels=[side]
                )
                self._log.log(f"world/hand/{side}/pad", box, static=True)
        self._log.log(
            "world/hand/axes", rr.Arrows3D(vectors=unit * 0.4, colors=_AXES, radii=0.0005), static=True
        )
        names = {"x": _AXES[0], "y": _AXES[1], "z": _AXES[2]}
        for axis, colour in names.items():
            self._log.log(
                f"plots/sigma/{axis}", rr.SeriesLines(colors=colour, names=f"σ {axis}"), static=True
            )
        for what, unit_name, colour in (
            ("residual", "mm", _BLUE),
            ("rate", "Hz", _GREEN),
            ("latency", "ms", _RED),
        ):
            self._log.log(
                f"plots/{what}/{unit_name}",
                rr.SeriesLines(colors=colour, names=f"{what}, {unit_name}"),
                static=True,
            )

    def _gel(self, side: Side, snapshot: Snapshot) -> None:
        rr, view = self._rr, snapshot.finger(side)
        if view.image is not None:
            image = rr.Image(view.image[..., ::-1].copy(), color_model="RGB").compress(jpeg_quality=85)
            self._log.log(f"tactile/{side}/image", image)
        if (
            view.uv_px is not None
            and view.uv_start_px is not None
            and len(view.uv_px) == len(view.uv_start_px)
        ):
            seen = np.isfinite(view.uv_px).all(axis=1) & np.isfinite(view.uv_start_px).all(axis=1)
            start, motion = view.uv_start_px[seen], (view.uv_px - view.uv_start_px)[seen]
            arrows = rr.Arrows2D(
                origins=start + 0.5, vectors=_ARROWS * motion, colors=(240, 228, 66), radii=0.7
            )
            self._log.log(f"tactile/{side}/image/markers", arrows)
        finger = self.depth_of.get(side)
        if finger is not None and finger.depth_m is not None:
            depth_um = np.clip(np.asarray(finger.depth_m) * 1e6, 0.0, 65535.0).astype(np.uint16)
            every = max(1, round(depth_um.shape[1] / 160))  # finer is beyond what a marker shows
            depth = rr.DepthImage(
                depth_um[::every, ::every], meter=1e6, colormap="viridis", depth_range=(0.0, 1500.0)
            )
            self._log.log(f"tactile/{side}/depth", depth)

    def _scene(self, snapshot: Snapshot) -> None:
        rr, estimate = self._rr, snapshot.estimate
        T = snapshot.T_B_E
        if T is not None:
            self._log.log("world/hand", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        if estimate.p_B is None:
            self._log.log("world/tip", rr.Clear(recursive=True))
            self._log.log("world/tool", rr.Clear(recursive=True))
            return
        p = estimate.p_B
        if estimate.phase is None or estimate.phase.value != "anchoring":
            self._path.append(p)
        self._log.log("world/tip", rr.Points3D([p], radii=0.0012, colors=_RED, labels=["tip"]))
        if T is not None and self._rig is not None:
            grip = np.mean([(T @ self._rig.T_E_S(side))[:3, 3] for side in SIDES], axis=0)
            self._log.log("world/tool", rr.LineStrips3D([np.array([grip, p])], colors=_GREY, radii=0.002))
        if estimate.covariance is not None and np.isfinite(estimate.covariance).all():
            values, vectors = np.linalg.eigh(estimate.covariance)  # (3,), (3, 3)
            vectors[:, 2] *= np.sign(np.linalg.det(vectors))
            half = 2.0 * MAGNIFIED * np.sqrt(np.maximum(values, 0.0))
            ellipsoid = rr.Ellipsoids3D(
                half_sizes=[np.minimum(half, 0.2)],
                centers=[p],
                quaternions=[rr.Quaternion(xyzw=_quaternion(vectors))],
                colors=_RED,
            )
            self._log.log("world/tip/uncertainty", ellipsoid)
        else:
            self._log.log("world/tip/uncertainty", rr.Clear(recursive=False))

    def _plots(self, snapshot: Snapshot) -> None:
        rr, estimate = self._rr, snapshot.estimate
        residual = None if estimate.residual_m is None else estimate.residual_m * 1e3
        latency = snapshot.latency_ms if snapshot.latency_ms is not None else estimate.loop_ms
        for name, value in (
            ("residual/mm", residual),
            ("rate/Hz", snapshot.rate_hz),
            ("latency/ms", latency),
        ):
            if value is not None and np.isfinite(value):
                self._log.log(f"plots/{name}", rr.Scalars(value))
        if estimate.p_B is not None and estimate.covariance is not None:
            for axis, variance in zip("xyz", np.diag(estimate.covariance), strict=True):
                self._log.log(f"plots/sigma/{axis}", rr.Scalars(1e3 * float(np.sqrt(max(variance, 0.0)))))

    def _log_path(self) -> None:
        if len(self._path) > 1:
            line = self._rr.LineStrips3D([np.array(self._path)], colors=_BLUE, radii=0.0005)
            self._log.log("world/trajectory", line)
            self._logged = len(self._path)

    def _text(self, text: str, level: str) -> None:
        self._log.log("events", self._rr.TextLog(text, level=level))


def _quaternion(R: FloatArray) -> FloatArray:
    from tiptrace.geometry.transforms import quaternion_from_rotation

    return quaternion_from_rotation(R)
