"""One gel: tactile image in, 3-D markers in F_S out (paper, Sec. II-B)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from tiptrace.config import Sensor
from tiptrace.errors import PerceptionError
from tiptrace.perception.background import check_untouched
from tiptrace.perception.depth import DepthMap, PaperDepth, at_image_size
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.lifters import FullLifter, Lifter, PaperLifter, PlanarLifter
from tiptrace.perception.lifting import lift
from tiptrace.perception.markers import Markers, check_image, check_pitch, detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.seeding import seed
from tiptrace.perception.settings import SensingConfig
from tiptrace.perception.tracking import LucasKanadeTracker, MarkerTracker
from tiptrace.perception.warm_up import warm_up
from tiptrace.types import BoolArray, FingerMarkers, FloatArray, Image, Side


class Finger:
    """Senses one gel: the first image in which markers are found starts it, later ones are tracked from it.

    Attributes:
        markers: The dots of the first image; None before it.
    """

    def __init__(
        self,
        sensor: Sensor,
        gel: GelModel | None,
        reference: Image | None,
        config: SensingConfig | None = None,
        *,
        side: Side | None = None,
    ) -> None:
        """Prepare one gel.

        Args:
            sensor: What the rig says about it.
            gel: Its calibrated network; None only with ``depth: none``.
            reference: Image of the untouched gel, (H, W, 3) uint8 BGR; needed for depth.
            config: Settings of the chain.
            side: Which finger it is, for error messages.

        Raises:
            PerceptionError: no reference or network where depth is wanted, or a reference that cannot be used.
        """
        self._sensor, self._config = sensor, config or SensingConfig()
        self._name = "" if side is None else f"{side} finger: "
        self._reference = reference
        self.markers: Markers | None = None
        self._map: DepthMap | None = None
        self._tracker: MarkerTracker | None = None
        self._lifter: Lifter | None = None
        warm_up()
        with self._named():
            if reference is not None:
                check_image(reference, sensor.image_size_px)
                check_untouched(reference)
            self._depth = self._depth_chain(gel, reference)

    @property
    def depth(self) -> DepthMap | None:
        """Latest depth map at image resolution; None before the first image and without a network."""
        W, H = self._sensor.image_size_px
        return None if self._map is None else at_image_size(self._map, (H, W))

    @property
    def depth_m(self) -> NDArray[np.float32] | None:
        """Latest depth map (H, W) m, positive = pressed in; None where there is none."""
        depth = self.depth
        return None if depth is None else depth.depth_m

    def sense(self, image: Image) -> FingerMarkers:
        """Markers of the next image, (H, W, 3) uint8 BGR, lifted to F_S.

        Raises:
            PerceptionError: another size than the rig says, black, overexposed, too few markers in the first.
        """
        with self._named():
            check_image(image, self._sensor.image_size_px)
            uv_px, tracked = self._track(image)
            assert self._lifter is not None
            depths = self._lifter(image, uv_px, tracked)
        self._map = depths.map
        x_S = lift(uv_px, depths.depth_m, self._sensor.image_size_px, self._sensor.metres_per_px)  # (n, 3)
        doubtful = isinstance(self._tracker, RegisteredTracker) and self._tracker.doubtful
        return FingerMarkers(x_S, tracked, uv_px, depths.sigma_m, doubtful)

    def match_anew(self) -> None:
        """Forget whose dots the markers are on, as far as the tracker can."""
        if isinstance(self._tracker, RegisteredTracker):
            self._tracker.match_anew()

    def _track(self, image: Image) -> tuple[FloatArray, BoolArray]:
        """Positions (n, 2), NaN where lost, and tracked (n,); the first image starts tracker and lifter."""
        if self._tracker is not None:
            return self._tracker.update(image)
        start = self._start_paper(image) if self._config.method == "paper" else self._start_full(image)
        check_pitch(start, self._sensor.marker_pitch_mm, self._sensor.mm_per_px)
        self.markers = start
        return start.uv_px.copy(), np.ones(len(start), dtype=np.bool_)

    def _start_paper(self, image: Image) -> Markers:
        markers = detect_markers(image)
        self._tracker = LucasKanadeTracker(image, markers.uv_px)
        if isinstance(self._depth, PaperDepth):
            self._lifter = PaperLifter(self._depth)
        else:
            self._lifter = PlanarLifter(markers.uv_px, self._config.indentation_m)
        return markers

    def _start_full(self, image: Image) -> Markers:
        seeds = seed(image, self._reference)
        tracker = RegisteredTracker(image, seeds.markers)
        self._tracker = tracker
        if isinstance(self._depth, FullDepth):
            self._lifter = FullLifter(self._depth, tracker, seeds.ghosts)
        else:
            self._lifter = PlanarLifter(seeds.rest_px, self._config.indentation_m)
        return Markers(tracker.start_px, seeds.markers.diameter_px)

    def _depth_chain(self, gel: GelModel | None, reference: Image | None) -> PaperDepth | FullDepth | None:
        if self._config.depth == "none":
            return None
        if reference is None:
            raise PerceptionError(
                "no image of the untouched gel: depth is measured against one; add reference_left.png and "
                "reference_right.png, or sense without depth (--depth none)"
            )
        if gel is None:
            raise PerceptionError("no gel model: calibrate the gel, or sense without depth (--depth none)")
        s_x, s_y = (float(s) for s in self._sensor.metres_per_px)
        if self._config.method == "paper":
            return PaperDepth(gel, reference, (s_x, s_y), self._sensor.marker_threshold)
        return FullDepth(gel, reference, (s_x, s_y), self._config.depth_step)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say in error messages which finger it is."""
        try:
            yield
        except PerceptionError as error:
            if not self._name:
                raise
            raise PerceptionError(f"{self._name}{error}") from None
