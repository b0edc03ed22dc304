"""Tracking that cannot drift: frame to frame for speed, each dot measured anew in every frame.

Lucas–Kanade brings each marker close; its dot's own centroid says where it is, so that no error is handed on.
A forward–backward check, the dot's ink and area, and the neighbours' displacement decide whether it is the right
dot. A marker that fails is lost in this frame; its place is predicted from its neighbours until the dot shows
again.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.perception.centroid import DotMeasurement, DotMeter
from tiptrace.perception.markers import Markers
from tiptrace.perception.neighbourhood import Neighbourhood
from tiptrace.perception.tracking import Grey, grey_image, lucas_kanade
from tiptrace.types import BoolArray, FloatArray, Image

_BACK_PX = 1.0  # forward–backward mismatch
_LEAP = 0.6  # of the pitch: a marker that moves so far more than the others has gone to another dot
_SAME_BRIGHTNESS = 0.02
_AREA = (0.4, 2.2)  # of the first frame's
_INK = 0.45  # of the first frame's contrast
_OFF_GRID = 0.38  # of the pitch: distance from where the neighbours say
_STEADY = 0.3  # of the pitch: a dot that moved less since the frame before is the same dot for certain …
_LEAPT = 0.1  # … unless so many of all leapt, as after a pause …
_DOUBT_FRAMES = 75  # … within so many frames
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
        self._doubt = 0  # frames to go until followed dots are believed again
        self._missed, self._frame = np.zeros(len(markers), dtype=np.intp), 0
        self.expected_px: FloatArray = self._rest.copy()

    @property
    def start_px(self) -> FloatArray:
        """Positions (n, 2) in the first image."""
        return self._rest.copy()

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
        leapt = np.count_nonzero(seen & ~steady) > _LEAPT * len(seen)
        self._doubt = _DOUBT_FRAMES if leapt else max(self._doubt - 1, 0)
        kept = seen & followed & steady & (self._doubt == 0)
        again = np.flatnonzero(seen & ~followed)
        seen[again] = _nearest_to_own(dots.uv_px[again], np.where(kept[:, None], dots.uv_px, guess), again)
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
        followed = _came_back(
            start, moved, back, there & again & self._tracked, _LEAP * self._around.pitch_px
        )
        limit = _OFF_GRID * self._around.pitch_px
        followed = self._around.drop_strays(moved - start, followed, limit)
        sure = self._steady(moved) & (self._doubt == 0)
        followed &= sure | self._around.drop_strays(moved - self._rest, followed, limit)
        predicted, enough = self._around.predict(moved - self._rest, followed)
        held = np.where(enough[:, None], self._rest + predicted, start)
        return np.where(followed[:, None], moved, held), followed

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
        ok = _look_alike(
            dots.uv_px, dots.ink, dots.area_px, self._ink[which], self._area[which], guess, reach
        )
        return ok & self._whole(dots.uv_px, shape)

    def _whole(self, uv: FloatArray, shape: tuple[int, ...]) -> BoolArray:
        """Whether dots at places (n, 2) lie in the image entirely."""
        return _inside_by(uv, self._margin, shape[1], shape[0])

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
        seen[missing] &= _nearest_to_own(found.uv_px, places, missing)
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
        _part_twins(uv, off, agreed, self._margin)
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


@compiled
def _nearest_to_own(found: FloatArray, places: FloatArray, missing: NDArray[np.intp]) -> BoolArray:
    """Whether dots (m, 2) found for missing markers lie nearer to these than to any other marker's place (n, 2)."""
    own = np.ones(len(missing), dtype=np.bool_)
    for k in range(len(missing)):
        u, v = found[k]
        i = missing[k]
        away = (u - places[i, 0]) ** 2 + (v - places[i, 1]) ** 2
        for j in range(len(places)):
            own[k] &= j == i or away <= (u - places[j, 0]) ** 2 + (v - places[j, 1]) ** 2
    return own


@compiled
def _part_twins(uv: FloatArray, off: FloatArray, seen: BoolArray, margin: float) -> None:
    """Of two markers on one dot, unmark the one that is further off its neighbours' displacement."""
    twice = seen.copy()
    for i in range(len(uv)):
        for j in range(i + 1, len(uv)):
            if twice[i] and twice[j] and (uv[i, 0] - uv[j, 0]) ** 2 + (uv[i, 1] - uv[j, 1]) ** 2 < margin**2:
                seen[i if off[i] > off[j] else j] = False


@compiled
def _came_back(
    start: FloatArray, moved: FloatArray, back: FloatArray, found: BoolArray, leap: float
) -> BoolArray:
    """Those found that come back to where they started, and do not leap away from the others (all (n, 2), (n,))."""
    n = len(start)
    ok = np.empty(n, dtype=np.bool_)
    u, v, count = np.empty(n), np.empty(n), 0
    for i in range(n):
        ok[i] = found[i] and np.hypot(back[i, 0] - start[i, 0], back[i, 1] - start[i, 1]) < _BACK_PX
        if ok[i]:
            u[count], v[count] = moved[i, 0] - start[i, 0], moved[i, 1] - start[i, 1]
            count += 1
    if count == 0:
        return ok
    common_u, common_v = np.median(u[:count]), np.median(v[:count])
    for i in range(n):
        away = np.hypot(moved[i, 0] - start[i, 0] - common_u, moved[i, 1] - start[i, 1] - common_v)
        ok[i] &= away < leap
    return ok


@compiled
def _look_alike(
    uv: FloatArray,
    ink: FloatArray,
    area: FloatArray,
    ink_0: FloatArray,
    area_0: FloatArray,
    guess: FloatArray,
    reach: FloatArray,
) -> BoolArray:
    """Whether dots have ink and area as in the first frame, within reach of where they were guessed (n,)."""
    ok = np.empty(len(uv), dtype=np.bool_)
    for i in range(len(uv)):
        ratio = area[i] / area_0[i]
        ok[i] = ink[i] > _INK * ink_0[i] and _AREA[0] < ratio < _AREA[1]
        ok[i] &= np.hypot(uv[i, 0] - guess[i, 0], uv[i, 1] - guess[i, 1]) < reach[i]
    return ok


@compiled
def _inside_by(uv: FloatArray, margin: float, width: int, height: int) -> BoolArray:
    """Whether places (n, 2) lie in an image, at least a margin from its outermost pixels."""
    ok = np.empty(len(uv), dtype=np.bool_)
    for i in range(len(uv)):
        ok[i] = margin <= uv[i, 0] <= width - 1 - margin and margin <= uv[i, 1] <= height - 1 - margin
    return ok
