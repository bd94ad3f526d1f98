"""Views whose grey tells which they are."""

from __future__ import annotations

import math
import zlib

import numpy as np

from csas_shadow_ros.core.geometry import Acoustics, ShadowCamera, ViewInfo, view_ground_to_pixel
from csas_shadow_ros.viewer.store import Entry

COUNT, PIXELS, SPACING_M = 90, 96, 0.05


def code_of(index: int) -> int:
    return 40 + 2 * index


def entry(index: int, *, count: int = COUNT, pixels: int = PIXELS, code: int | None = None) -> Entry:
    """A view at aspect 360° · index / count, all of one code."""
    aspect = math.tau * index / count
    sonar = (75 * math.cos(aspect), 75 * math.sin(aspect), 30.0)
    to_pixel = view_ground_to_pixel(aspect, SPACING_M, pixels, pixels, (0.0, 0.0))
    camera = ShadowCamera.from_ground(to_pixel, sonar, pixels, pixels)
    acoustics = Acoustics(120e3, 40e3, 1500.0, 1)
    info = ViewInfo(10**18 + index * 10**9, camera, acoustics, aspect, math.radians(12))
    codes = np.full((pixels, pixels), code_of(index) if code is None else code, np.uint8)
    return Entry(info, f"{zlib.crc32(codes.tobytes()):08x}", lambda: codes)
