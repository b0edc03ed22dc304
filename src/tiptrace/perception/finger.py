"""One gel: tactile image in, 3-D markers in F_S out (paper, Sec. II-B)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tiptrace.config import Sensor
from tiptrace.errors import PerceptionError
from tiptrace.perception.depth import DepthMap, PaperDepth
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.lifting import lift, sample_map
from tiptrace.perception.markers import Markers, check_image, detect_markers
from tiptrace.perception.settings import SensingConfig
from tiptrace.perception.tracking import LucasKanadeTracker, MarkerTracker
from tiptrace.types import FingerMarkers, Image, Side


class Finger:
    """Senses one gel: the first image in which markers are found starts it, later ones are tracked from it.

    Attributes:
        markers: The dots of the first image; None before it.
        depth: The latest depth map with what is known about it; None before the first image.
    """

    def __init__(
        self,
        sensor: Sensor,
        gel: GelModel,
        reference: Image | None,
        config: SensingConfig | None = None,
        *,
        side: Side | None = None,
    ) -> None:
        """Prepare one gel.

        Args:
            sensor: What the rig says about it.
            gel: Its calibrated network.
            reference: Image of the untouched gel, (H, W, 3) uint8 BGR.
            config: Settings of the chain.
            side: Which finger it is, for error messages.

        Raises:
            PerceptionError: no reference, or one that cannot be used.
        """
        self._sensor, self._config = sensor, config or SensingConfig()
        self._name = "" if side is None else f"{side} finger: "
        self.markers: Markers | None = None
        self.depth: DepthMap | None = None
        self._tracker: MarkerTracker | None = None
        with self._named():
            self._depth = self._depth_chain(gel, reference)

    @property
    def depth_m(self) -> NDArray[np.float32] | None:
        """Latest depth map (H, W) m, positive = pressed in; None before the first image."""
        return None if self.depth is None else self.depth.depth_m

    def sense(self, image: Image) -> FingerMarkers:
        """Markers of the next image, (H, W, 3) uint8 BGR, lifted to F_S.

        Raises:
            PerceptionError: another size than the rig says, black, overexposed, too few markers in the first.
        """
        with self._named():
            return self._sense(image)

    def _sense(self, image: Image) -> FingerMarkers:
        check_image(image, self._sensor.image_size_px)
        if self._tracker is None:
            self.markers = detect_markers(image)
            self._tracker = LucasKanadeTracker(image, self.markers.uv_px)
            uv_px, tracked = self.markers.uv_px.copy(), np.ones(len(self.markers), dtype=np.bool_)
        else:
            uv_px, tracked = self._tracker.update(image)
        self.depth = self._depth(image)
        h = sample_map(self.depth.depth_m, uv_px)  # (n,)
        x_S = lift(uv_px, h, self._sensor.image_size_px, self._sensor.metres_per_px)  # (n, 3)
        return FingerMarkers(x_S=x_S, tracked=tracked, uv_px=uv_px)

    def _depth_chain(self, gel: GelModel, reference: Image | None) -> DepthChain:
        if reference is None:
            raise PerceptionError(
                "no image of the untouched gel: depth is measured against one; add reference_left.png and "
                "reference_right.png, or sense without depth (--depth none)"
            )
        check_image(reference, self._sensor.image_size_px)
        s_x, s_y = self._sensor.metres_per_px
        return PaperDepth(gel, reference, (float(s_x), float(s_y)), self._sensor.marker_threshold)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say in error messages which finger it is."""
        try:
            yield
        except PerceptionError as error:
            if not self._name:
                raise
            raise PerceptionError(f"{self._name}{error}") from None


class DepthChain(Protocol):
    """Image to depth map."""

    def __call__(self, image: Image) -> DepthMap:
        """Depth of an image of the same size as the reference."""
        ...
