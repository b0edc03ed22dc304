"""Tracking that cannot drift: frame to frame for speed, each dot measured anew in every frame.

Lucas–Kanade brings each marker close; its dot's own centroid says where it is, so that no error is handed on.
A forward–backward check, the dot's ink and area, and the neighbours' displacement decide whether it is the right
dot. A marker that fails is lost in this frame; its place is predicted from its neighbours until the dot shows
again. Where many leap or are lost at once, nobody saw the way: all are matched to all dots anew.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.perception.centroid import DotMeasurement, DotMeter
from tiptrace.perception.dot_checks import (
    INK,
    came_back,
    inside_by,
    look_alike,
    nearest_to_own,
    part_twins,
)
from tiptrace.perception.markers import Markers
from tiptrace.perception.neighbourhood import Neighbourhood
from tiptrace.perception.reseating import Seating
from tiptrace.perception.tracking import Grey, grey_image, lucas_kanade
from tiptrace.types import BoolArray, FloatArray, Image

_LEAP = 0.6  # of the pitch: a marker that moves so far more than the others has gone to another dot
_SAME_BRIGHTNESS = 0.02
_OFF_GRID = 0.38  # of the pitch: distance from where the neighbours say
_STEADY = 0.3  # of the pitch: a dot that moved less since the frame before is the same dot for certain …
_UPSET = 0.07  # … unless so many of all leapt or were lost, as after a pause: all are matched anew …
_LEAPT, _ALL_THERE = (
    0.04,
    0.97,
)  # … if not only dots are hidden: so many leapt, or as many dots show as before …
_AGAIN = 10  # … and every so many frames, while there is more than one way to match them
_SEARCH = 0.45  # of the pitch: how far from its predicted place a lost dot is looked for …
_FOUND = 0.6  # … and may be found
_MARGIN_PX = 1.0  # around a dot, where the network must not look either
_EVERY = slice(None)
_SEARCH_FRAMES = (
    5  # a dot is looked for in each of the first frames that it is missing from, then in every fifth
)


class RegisteredTracker:
    """The full method's tracker. Attribute ``expected_px`` (n, 2): where lost markers are thought to be."""

    def __init__(self, image: Image, markers: Markers) -> None:
        """Start on the image in which the markers were detected."""
        self._grey = grey_image(image)
        self._around = Neighbourhood(markers.uv_px)
        diameter = float(np.median(markers.diameter_px))
        self._meter = DotMeter(diameter, self._around.pitch_px)
        first = self._meter.measure(self._grey, markers.uv_px)
        moved = np.linalg.norm(first.uv_px - markers.uv_px, axis=1)
        self._rest = np.where((moved < 0.5 * diameter)[:, None], first.uv_px, markers.uv_px)
        self._ink, self._area = first.ink, first.area_px
        self._margin = 0.4 * diameter
        self._tracked = np.ones(len(markers), dtype=np.bool_)
        self._seating = Seating(self._rest, self._around.pitch_px)
        self._sure_px: FloatArray | None = None  # places before a leap that has not been decided
        self._missed, self._frame = np.zeros(len(markers), dtype=np.intp), 0
        self.expected_px: FloatArray = self._rest.copy()

    @property
    def start_px(self) -> FloatArray:
        """Positions (n, 2) in the first image."""
        return self._rest.copy()

    @property
    def doubtful(self) -> bool:
        """Whether markers leapt and there is more than one way to tell whose dots are whose since."""
        return self._sure_px is not None

    def match_anew(self) -> None:
        """Markers may be on others' dots: from the next frames on they are matched to all dots from where they rest."""
        self._sure_px = self._rest.copy()

    @property
    def mask_radius_px(self) -> float:
        """Radius of the discs of :meth:`mask`."""
        return self._meter.mask_radius_px

    def mask(self, uv_px: FloatArray, shape: tuple[int, int], step: int = 1) -> BoolArray:
        """Pixels of dots at places (n, 2), with a margin, in a map (H, W) that has every ``step``-th pixel."""
        return self._meter.mask(uv_px, shape, step, _MARGIN_PX)

    def update(self, image: Image) -> tuple[FloatArray, BoolArray]:
        """Track into the next image: uv_px (n, 2), NaN where lost, and tracked (n,)."""
        grey = grey_image(image)
        guess, followed = self._follow(grey)
        dots = self._meter.measure(grey, guess)
        near = max(2.0, 0.12 * self._around.pitch_px), _SEARCH * self._around.pitch_px
        seen = self._is_dot(dots, guess, np.where(followed, *near), _EVERY, grey.shape)
        steady = self._steady(dots.uv_px)
        kept = seen & followed & steady
        spots = self._spots_after_leap(grey, seen & ~steady, kept)
        if spots is not None:
            held = np.where((seen & followed)[:, None], dots.uv_px, np.nan)
            guess, followed = self._reseat(spots, held, grey.shape)
            dots = self._meter.measure(grey, guess)
            seen = self._is_dot(dots, guess, np.where(followed, *near), _EVERY, grey.shape)
            kept = seen & followed
        again = np.flatnonzero(seen & ~followed)
        seen[again] = nearest_to_own(dots.uv_px[again], np.where(kept[:, None], dots.uv_px, guess), again)
        uv, seen = self._search(grey, guess, dots.uv_px, seen)
        seen = self._agree(grey, uv, seen, kept)
        predicted, _ = self._around.predict(uv - self._rest, seen)
        self.expected_px = np.where(seen[:, None], uv, self._rest + predicted)
        self._tracked, self._grey = seen, grey
        return np.where(seen[:, None], uv, np.nan), seen.copy()

    def _follow(self, grey: Grey) -> tuple[FloatArray, BoolArray]:
        """Lucas–Kanade there and back; where that fails, the neighbours' displacement."""
        start = self.expected_px
        now = self._as_bright_as_before(grey)
        moved, there = lucas_kanade(self._grey, now, start)
        back, again = lucas_kanade(now, self._grey, moved, start, max_level=0)
        followed = came_back(start, moved, back, there & again & self._tracked, _LEAP * self._around.pitch_px)
        limit = _OFF_GRID * self._around.pitch_px
        followed = self._around.drop_strays(moved - start, followed, limit)
        followed &= self._steady(moved) | self._around.drop_strays(moved - self._rest, followed, limit)
        predicted, enough = self._around.predict(moved - self._rest, followed)
        held = np.where(enough[:, None], self._rest + predicted, start)
        return np.where(followed[:, None], moved, held), followed

    def _spots_after_leap(self, grey: Grey, leapt: BoolArray, kept: BoolArray) -> FloatArray | None:
        """All dots (m, 2) px of an image where markers have to be matched anew; None where they need not.

        Args:
            grey: The image.
            leapt: Markers (n,) seen far from where they were.
            kept: Markers (n,) followed without a break.
        """
        if self.doubtful and self._frame % _AGAIN == 0:
            return self._dots(grey)
        if np.count_nonzero(self._tracked & ~kept) <= _UPSET * len(kept):
            return None
        spots = self._dots(grey)
        hidden = len(spots) < _ALL_THERE * np.count_nonzero(self._tracked)
        return None if hidden and np.count_nonzero(leapt) <= _LEAPT * len(kept) else spots

    def _reseat(
        self, spots: FloatArray, held: FloatArray, shape: tuple[int, ...]
    ) -> tuple[FloatArray, BoolArray]:
        """Match all markers to all dots (m, 2); where that does not tell, the neighbours' displacement.

        Held: (n, 2) where following them led, NaN where it did not.
        """
        before = self.expected_px if self._sure_px is None else self._sure_px
        seats = self._seating.seats(before, spots, held, shape)
        self._sure_px = None if seats.decided else before
        seated = np.isfinite(seats.uv_px[:, 0])
        predicted, _ = self._around.predict(
            np.where(seated[:, None], seats.uv_px, before) - self._rest, seated
        )
        return np.where(seated[:, None], seats.uv_px, self._rest + predicted), seated

    def _dots(self, grey: Grey) -> FloatArray:
        """All that looks like dots, (m, 2) px."""
        size = 2 * round(_OFF_GRID * self._around.pitch_px) + 1
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), max(self._margin * 0.6, 0.8))
        depth = 1.0 - smooth / np.maximum(cv2.blur(smooth, (2 * size, 2 * size)), 1.0)
        v, u = np.nonzero(smooth == cv2.erode(smooth, np.ones((size, size), dtype=np.uint8)))
        usual = np.median(np.sort(depth[v, u])[-len(self._ink) :])
        plain = depth[v, u] > INK * usual
        dips = np.column_stack([u[plain], v[plain]]).astype(np.float64)
        dots = self._meter.measure(grey, dips)
        ink, area = np.full(len(dips), np.median(self._ink)), np.full(len(dips), np.median(self._area))
        reach = np.full(len(dips), self._margin)
        ok = look_alike(dots.uv_px, dots.ink, dots.area_px, ink, area, dips, reach)
        ok &= self._whole(dots.uv_px, grey.shape)
        part_twins(dots.uv_px, -dots.ink, ok, self._margin)
        return dots.uv_px[ok]

    def _steady(self, uv: FloatArray) -> BoolArray:
        """Markers (n,) that are not far from where they were in the frame before."""
        step = np.linalg.norm(uv - self.expected_px, axis=1)
        return np.asarray(step < _STEADY * self._around.pitch_px)

    def _as_bright_as_before(self, grey: Grey) -> Grey:
        """Lucas–Kanade takes a change of brightness for motion: lamps are evened out first."""
        gain = cv2.mean(self._grey)[0] / max(cv2.mean(grey)[0], 1.0)
        if abs(gain - 1.0) < _SAME_BRIGHTNESS:
            return grey
        return np.asarray(cv2.convertScaleAbs(grey, alpha=gain), dtype=np.uint8)

    def _is_dot(
        self,
        dots: DotMeasurement,
        guess: FloatArray,
        reach: FloatArray,
        which: slice | NDArray[np.intp],
        shape: tuple[int, ...],
    ) -> BoolArray:
        """Whether measurements of some markers show their dots.

        A dot is dark, of the right size, not cut by the border, and within a reach (n,) of where it was guessed (n, 2).
        """
        ok = look_alike(dots.uv_px, dots.ink, dots.area_px, self._ink[which], self._area[which], guess, reach)
        return ok & self._whole(dots.uv_px, shape)

    def _whole(self, uv: FloatArray, shape: tuple[int, ...]) -> BoolArray:
        """Whether dots at places (n, 2) lie in the image entirely."""
        return inside_by(uv, self._margin, shape[1], shape[0])

    def _search(
        self, grey: Grey, guess: FloatArray, uv: FloatArray, seen: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Look for missing dots around their predicted places, darkest first."""
        self._frame += 1
        self._missed = np.where(seen, 0, self._missed + 1)
        due = (self._missed <= _SEARCH_FRAMES) | (self._frame % _SEARCH_FRAMES == 0)
        missing = np.flatnonzero(~seen & due & self._whole(guess, grey.shape))
        if not missing.size:
            return uv, seen
        uv, seen = uv.copy(), seen.copy()
        for i in missing:
            uv[i] = self._darkest(grey, guess[i])
        found = self._meter.measure(grey, uv[missing])
        uv[missing] = found.uv_px
        reach = np.full(len(missing), _FOUND * self._around.pitch_px)
        places = np.where(seen[:, None], uv, guess)  # of all markers, as far as is known
        seen[missing] = self._is_dot(found, guess[missing], reach, missing, grey.shape)
        seen[missing] &= nearest_to_own(found.uv_px, places, missing)
        return uv, seen

    def _darkest(self, grey: Grey, guess: FloatArray) -> tuple[int, int]:
        """The darkest place (u, v) around a guess (2,) in the image, dots smoothed to one dip."""
        sigma = max(self._margin * 0.6, 0.8)
        reach, rim = int(np.ceil(_SEARCH * self._around.pitch_px)), int(np.ceil(3.0 * sigma))
        u, v = round(guess[0]), round(guess[1])
        u0, v0 = max(u - reach - rim, 0), max(v - reach - rim, 0)
        smooth = cv2.GaussianBlur(grey[v0 : v + reach + rim + 1, u0 : u + reach + rim + 1], (0, 0), sigma)
        u1, v1 = max(u - reach, 0), max(v - reach, 0)
        core = smooth[v1 - v0 : v + reach + 1 - v0, u1 - u0 : u + reach + 1 - u0]
        _, _, (x, y), _ = cv2.minMaxLoc(core)
        return u1 + x, v1 + y

    def _agree(self, grey: Grey, uv: FloatArray, seen: BoolArray, followed: BoolArray) -> BoolArray:
        """Drop markers off their neighbours' displacement, worst first, and two markers on one dot.

        Gel that breaks loose shears by up to a pitch between rows: a dot that was followed here is only given up
        where another, that is nobody's, shows at the place that the neighbours name.
        """
        agreed, off = self._around.agreeing(uv - self._rest, seen, _OFF_GRID * self._around.pitch_px)
        strays = np.flatnonzero(followed & ~agreed)
        if strays.size:
            predicted, _ = self._around.predict(uv - self._rest, agreed)
            agreed[strays] = ~self._show(grey, self._rest + predicted, uv, strays, seen)
        part_twins(uv, off, agreed, self._margin)
        return agreed

    def _show(
        self, grey: Grey, places: FloatArray, uv: FloatArray, which: NDArray[np.intp], seen: BoolArray
    ) -> BoolArray:
        """Whether dots of some markers (m,) show at places (n, 2) where no marker is seen (n,)."""
        dots = self._meter.measure(grey, places[which])
        reach = np.full(len(which), _OFF_GRID * self._around.pitch_px)
        found = self._is_dot(dots, places[which], reach, which, grey.shape)
        taken = np.linalg.norm(dots.uv_px[:, None] - uv[seen], axis=2).min(axis=1) < self._margin
        return np.asarray(found & ~taken)
