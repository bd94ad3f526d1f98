"""What a search that found nothing would have found: bodies put into its views.

"No object" says as much as the search could have seen. Dark or rough seabed hides bodies, and no threshold of
the search tells how large. So shadows of standard bodies are put into the views themselves, at nine places at
once, and it is searched again, for larger ones until they are found.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..shape.result import Detectable
from .bodies import MEAN, UNKNOWN, Judged, Look, Search, cell_m, look_again, look_locally, smoothing_px

#: How far under the seabed the shadow put in lies (dB): the least contrast that found objects are asked of.
_CONTRAST_DB = 6.0
#: From the scene's middle so far out, to either side and along both axes (share of its side): nine places.
_PLACES = (-0.3, 0.0, 0.3)
#: It is half as high as wide, like many mines. Its width: so many of the search's resolution cells at first,
#: each time by the factor larger, and up to this share of the scene's side, where two places would touch.
_LEAST_CELLS, _FACTOR, _LARGEST = 1.0, math.sqrt(2.0), 1.0 / 6.0


def detectable_of(search: Search) -> Detectable | None:
    """Return the smallest standard body that the search's second look would have found in its views.

    Parameters
    ----------
    search : Search
        That found nothing; None is returned of one that found something.

    Returns
    -------
    Detectable
        The first that is found at eight places of nine; if none is, the largest that was tried.
    """
    if not search.looks:
        return None
    volume, camera = search.volume, search.looks[0].power.info.camera
    side_m = volume.size_m[0]
    middle = (float(volume.x_m.mean()), float(volume.y_m.mean()))
    offsets = [share * side_m for share in _PLACES]
    places = [(middle[0] + dx, middle[1] + dy) for dx, dy in itertools.product(offsets, repeat=2)]
    half_px = smoothing_px(side_m, camera)
    size = _LEAST_CELLS * cell_m(search.looks)
    while True:
        height = size / 2.0
        put_in = [_with_bodies(look, places, size, height, half_px) for look in search.looks]
        judged = Judged()
        look_again(judged, put_in, volume)
        look_locally(judged, put_in, volume)
        at = np.array(judged.places).reshape(-1, 2)
        near = max(size, 2.0 * volume.voxel_size_m)
        found = sum(bool((np.hypot(*(at - place).T) <= near).any()) for place in places)
        told = Detectable(size, height, _CONTRAST_DB, found, len(places))
        if told.is_enough or size * _FACTOR > _LARGEST * side_m:
            return told
        size *= _FACTOR


def _with_bodies(
    look: Look,
    places: Sequence[tuple[float, float]],
    size_m: float,
    height_m: float,
    half_px: tuple[int, int],
) -> Look:
    """Put upright cylinders into a look, as smooth as it is: shadows, and echoes as bright as the seabed."""
    camera = look.power.info.camera
    pixels = look.power.pixels.copy()
    sonar_x, sonar_y, sonar_z = map(float, camera.sonar_m)
    reach = height_m / (sonar_z - height_m)
    row_m, col_m = camera.spacing_m
    down_m, across_m = look.power.info.resolution_m
    cell_px = max(1, round(across_m / col_m)), max(1, round(down_m / row_m))
    room = np.array([half_px[1] + 2.0 + size_m / col_m, half_px[0] + 2.0 + size_m / row_m])
    for x, y in places:
        tip = x + (x - sonar_x) * reach, y + (y - sonar_y) * reach
        over = reach * math.tan(camera.grazing_rad) ** 2  # its echo is laid over towards the sonar
        near = x - (x - sonar_x) * over, y - (y - sonar_y) * over
        ends = (camera.ground_to_pixel @ np.array([[x, tip[0]], [y, tip[1]], [1.0, 1.0]]))[:2]
        first = np.clip(ends.min(axis=1) - room, 0, (camera.cols, camera.rows)).astype(np.intp)
        last = np.clip(ends.max(axis=1) + room, 0, (camera.cols, camera.rows)).astype(np.intp)
        box = slice(first[1], last[1]), slice(first[0], last[0])
        if pixels[box].size:
            ground = camera.pixel_to_ground
            dark, echo = (_between((x, y), end, size_m / 2.0, ground, box) for end in (tip, near))
            power = (1.0 - (1.0 - 10.0 ** (-_CONTRAST_DB / 10.0)) * dark) * (1.0 - echo)
            left, echo = (_smooth(values, cell_px, half_px) for values in (power, echo))
            known = pixels[box] != UNKNOWN
            pixels[box][known] = (pixels[box] * left + MEAN * echo + 0.5).astype(np.uint8)[known]
    return replace(look, power=replace(look.power, pixels=pixels))


def _smooth(
    sharp: NDArray[np.float32], cell_px: tuple[int, int], half_px: tuple[int, int]
) -> NDArray[np.float32]:
    """Blur by a resolution cell (columns, rows) and by a look's square (half of it in rows, columns)."""
    return np.asarray(cv2.blur(cv2.blur(sharp, cell_px), (2 * half_px[1] + 1, 2 * half_px[0] + 1)))


def _between(
    foot: tuple[float, float],
    tip: tuple[float, float],
    radius_m: float,
    pixel_to_ground: NDArray[np.float64],
    box: tuple[slice, slice],
) -> NDArray[np.float32]:
    """Return 1 for the pixels of a box that lie as near to a line on the ground, else 0."""
    v, u = np.mgrid[box]
    x, y = (m[0] * u + m[1] * v + m[2] for m in pixel_to_ground[:2])
    dx, dy = tip[0] - foot[0], tip[1] - foot[1]
    along = np.clip(((x - foot[0]) * dx + (y - foot[1]) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
    away = np.hypot(x - foot[0] - along * dx, y - foot[1] - along * dy)
    return np.asarray(away <= radius_m, np.float32)
