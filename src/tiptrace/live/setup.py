"""First contact with the hardware: which camera is which finger, its crop, and the untouched references."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.config import Camera as CameraSettings
from tiptrace.config import Rig, Sensor, dump_yaml
from tiptrace.drivers.base import Camera
from tiptrace.drivers.camera import RawFrame
from tiptrace.drivers.opening import camera_source, open_camera
from tiptrace.drivers.picture import PictureError, decode_jpeg, inspect_jpeg
from tiptrace.drivers.timeline import Timeline
from tiptrace.drivers.v4l2 import describe, list_cameras
from tiptrace.errors import DeviceError, OutputError, PerceptionError
from tiptrace.perception.background import check_untouched
from tiptrace.perception.markers import check_image, detect_markers
from tiptrace.streams.topics import REFERENCE_FILE, RIG_FILE
from tiptrace.types import SIDES, Image, Side

_BORDER = 1.0 / 7.0  # of a GelSight Mini's image, on each side, that shows the gel's edge
_LOOK_PX = (64, 48)
_TOUCH_LEVELS = 6.0  # mean change over the busiest tenth of the picture that is a touch
_TIMES_OTHER = 2.0  # and so much more than at the other camera
_TRIED_FRAMES = 25
_REFERENCE_FRAMES = 20
_STILL_LEVELS = 4.0  # spread of a pixel while nothing touches, median over the picture

Say = Callable[[str], None]
Pictures = dict[str, NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A camera that may be a finger."""

    address: str
    camera: Camera


def candidates(addresses: list[str]) -> list[str]:
    """The addresses given, else those of all cameras of this machine.

    Raises:
        DeviceError: fewer than two.
    """
    if addresses:
        found = addresses
    else:
        cameras = list_cameras()
        serials = [camera.serial for camera in cameras]
        found = [
            f"v4l2:{c.serial}" if c.serial and serials.count(c.serial) == 1 else str(c.path) for c in cameras
        ]
    if len(set(found)) < 2:
        raise DeviceError(
            f"two cameras are needed, one per finger; {describe(list_cameras())}; others are given with --camera http://…"
        )
    return found


def crop_for(size_px: tuple[int, int], image_size_px: tuple[int, int]) -> tuple[int, int, int, int]:
    """(left, top, width, height): a GelSight Mini's border cut off, of the aspect ratio of the processed image."""
    W, H = size_px
    w, h = W * (1 - 2 * _BORDER), H * (1 - 2 * _BORDER)
    aspect = image_size_px[0] / image_size_px[1]
    w, h = (min(w, h * aspect), min(h, w / aspect))
    width, height = round(w), round(h)
    return (W - width) // 2, (H - height) // 2, width, height


class Setup:
    """One go at setting up: cameras run while the user touches the gels.

    Args:
        rig: Where extrinsics, gel models and scales come from.
        addresses: Of the cameras to try.
        say: Tells the user what to do.
        crop: Whether to cut off the gel's border; else the whole image is used.
    """

    def __init__(self, rig: Rig, addresses: list[str], say: Say, *, crop: bool = True) -> None:
        self._rig, self._addresses, self._say, self._crop = rig, addresses, say, crop
        self._timeline = Timeline()

    def identify(self, timeout_s: float = 60.0) -> dict[Side, str]:
        """Ask for a touch of the left gel, then of the right one; the address of each finger's camera.

        Raises:
            DeviceError: a camera that does not start, no touch in time, or the same camera twice.
        """
        told = self._rig.sensors.left.camera or CameraSettings()
        plain = self._rig.sensors.left.model_copy(  # look at all of it
            update={"image_size_px": _LOOK_PX, "camera": CameraSettings(fourcc=told.fourcc)}
        )
        opened: list[Candidate] = []
        try:
            for address in self._addresses:
                camera = open_camera(address, plain, self._timeline)
                camera.start(lambda: None)
                opened.append(Candidate(address, camera))
            found: dict[Side, str] = {}
            calm = {c.address: _look(c) for c in opened}
            for side in SIDES:
                self._say(f"touch the {side} gel with a finger, and let go")
                found[side] = _wait_for_touch(opened, calm, timeout_s)
                if side == "right" and found["left"] == found["right"]:
                    raise DeviceError(
                        f"both touches were seen by {found['left']}: touch one gel at a time, and start again"
                    )
                self._say(f"{side}: {found[side]}")
                _wait_for_calm(opened, calm, timeout_s)
            return found
        finally:
            for candidate in opened:
                candidate.camera.close()

    def sensor(self, side: Side, address: str) -> Sensor:
        """The finger's settings with its camera, crop and size.

        Raises:
            DeviceError: the camera does not start.
        """
        old = self._rig.sensor(side)
        size = self._source_size(address, old)
        crop = crop_for(size, old.image_size_px) if self._crop else None
        camera = (old.camera or CameraSettings()).model_copy(
            update={"source": address, "size_px": size, "crop_px": crop}
        )
        return old.model_copy(update={"camera": camera})

    def _source_size(self, address: str, sensor: Sensor) -> tuple[int, int]:
        source = camera_source(address, sensor, self._timeline)
        source.connect()
        try:
            for _ in range(_TRIED_FRAMES):  # the first ones of a camera may be damaged
                with suppress(PictureError):
                    return _size_px(source.read())
        finally:
            source.disconnect()
        raise DeviceError(f"{address}: sends damaged images only: check the cable")

    def reference(self, side: Side, sensor: Sensor, address: str) -> Image:
        """Mean of some frames of the untouched gel.

        Raises:
            DeviceError: the camera does not start.
            PerceptionError: the gel moves, is touched, black, overexposed, or shows no markers.
        """
        camera = open_camera(address, sensor, self._timeline)
        frames: list[Image] = []
        camera.start(lambda: None)
        try:
            end = time.monotonic() + 5.0
            while len(frames) < _REFERENCE_FRAMES and time.monotonic() < end:
                frames += [frame.image for frame in camera.take()]
                time.sleep(0.02)
        finally:
            camera.close()
        return make_reference(side, frames)

    def write(self, folder: Path, sensors: Mapping[Side, Sensor], references: Mapping[Side, Image]) -> Path:
        """Write ``rig.yaml`` and the references; the rig file's path.

        Raises:
            OutputError: it is there already, or cannot be written.
        """
        rig = self._rig.model_copy(
            update={"sensors": self._rig.sensors.model_copy(update={str(k): v for k, v in sensors.items()})}
        )
        path = folder / RIG_FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with path.open("x", encoding="utf-8") as file:
                file.write(dump_yaml(rig))
            for side, image in references.items():
                (folder / REFERENCE_FILE[side]).write_bytes(cv2.imencode(".png", image)[1].tobytes())
        except FileExistsError:
            raise OutputError(f"{path}: exists already; give another folder with --out") from None
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
        return path


def with_gel_models(rig: Rig, folder: Path) -> Rig:
    """The rig, for a file in another folder: gel models that lie beside the old one are named by their whole path."""
    sensors = {}
    for side in SIDES:
        sensor, model = rig.sensor(side), folder / rig.sensor(side).gel_model
        update = {"gel_model": str(model.resolve())} if model.is_file() else {}
        sensors[str(side)] = sensor.model_copy(update=update)
    return rig.model_copy(update={"sensors": rig.sensors.model_copy(update=sensors)})


def refuse_an_old_rig(folder: Path) -> None:
    """There must be no rig file in the folder yet; told before anybody touches a gel.

    Raises:
        OutputError: there is.
    """
    path = folder / RIG_FILE
    if path.exists():
        raise OutputError(f"{path}: exists already; give another folder with --out")


def _size_px(raw: RawFrame) -> tuple[int, int]:
    """Width and height of what a camera sends.

    Raises:
        PictureError: damaged.
    """
    image = raw.image
    if raw.jpeg is not None:
        inspect_jpeg(raw.jpeg)
        image = decode_jpeg(raw.jpeg)
    assert image is not None
    return image.shape[1], image.shape[0]


def make_reference(side: Side, frames: list[Image]) -> Image:
    """Mean of frames of an untouched gel, checked.

    Raises:
        PerceptionError: see :meth:`Setup.reference`.
    """
    if len(frames) < _REFERENCE_FRAMES // 2:
        raise PerceptionError(f"{side} gel: only {len(frames)} images came: check the camera")
    stack = np.stack(frames).astype(np.float32)  # (n, H, W, 3)
    if float(np.median(stack.std(axis=0))) > _STILL_LEVELS:
        raise PerceptionError(
            f"{side} gel: the image moves: let go of the gel, keep the lamps steady, and try again"
        )
    image: Image = np.round(stack.mean(axis=0)).astype(np.uint8)
    try:
        check_image(image)
        check_untouched(image)
        detect_markers(image)
    except PerceptionError as error:
        raise PerceptionError(f"{side} gel: {error}") from None
    return image


def _wait_for_touch(cameras: list[Candidate], calm: Pictures, timeout_s: float) -> str:
    """Address of the camera whose picture changes, clearly more than all others'.

    Raises:
        DeviceError: none in time.
    """
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        change = _changes(cameras, calm)
        order = sorted(change, key=lambda address: -change[address])
        if change[order[0]] > _TOUCH_LEVELS and change[order[0]] > _TIMES_OTHER * change[order[1]]:
            return order[0]
    raise DeviceError(f"no touch was seen within {timeout_s:g} s: press the gel firmly, and start again")


def _wait_for_calm(cameras: list[Candidate], calm: Pictures, timeout_s: float) -> None:
    """Until the pictures have been for half a second what they were before any touch.

    Raises:
        DeviceError: they do not come back.
    """
    end, since = time.monotonic() + timeout_s, time.monotonic()
    while time.monotonic() < end:
        if max(_changes(cameras, calm).values()) > 0.5 * _TOUCH_LEVELS:
            since = time.monotonic()
        if time.monotonic() - since > 0.5:
            return
    raise DeviceError(
        "the pictures do not come back to what they were: let go of the gels, keep the lamps steady, and start again"
    )


def _changes(cameras: list[Candidate], calm: Pictures) -> dict[str, float]:
    """Mean change over the busiest tenth of each camera's newest picture, grey levels."""
    time.sleep(0.05)
    return {c.address: _change(_look(c), calm[c.address]) for c in cameras}


def _look(candidate: Candidate) -> NDArray[np.float32]:
    """The camera's newest picture.

    Raises:
        DeviceError: there is none for two seconds.
    """
    for _ in range(100):
        frames = candidate.camera.take()
        if frames:
            return cv2.GaussianBlur(frames[-1].image, (0, 0), 1.0).astype(np.float32)
        time.sleep(0.02)
    raise DeviceError(f"{candidate.address}: sends no new pictures: check its cable")


def _change(now: NDArray[np.float32], calm: NDArray[np.float32]) -> float:
    """Mean change over the busiest tenth of the picture, grey levels."""
    change = np.abs(now - calm).mean(axis=2).ravel()
    return float(np.sort(change)[-len(change) // 10 :].mean())
