"""Geometry: ground grids, the track, the shadow camera and the view frame.

Frames (SI, radians). The scene frame is x east, y north, z up, z = 0 on the seabed. The aspect θ is
the azimuth of the sonar seen from the scene's origin, counter-clockwise from +x, and û(θ) = (cos θ,
sin θ) points to the sonar. A view of aspect θ has cross-range e_c = (sin θ, -cos θ) along its
columns and down-range e_r = -û(θ) along its rows: the sonar is above the picture and shadows fall
downwards. See ``docs/conventions.md``.
"""

from __future__ import annotations

from ..frame_name import SCENE_FRAME
from .camera import (
    ShadowCamera,
    shadow_matrix,
    view_ground_to_pixel,
)
from .frames import (
    TWO_PI,
    Acoustics,
    FloatArray,
    GroundGrid,
    aspects_of_step,
    cross_range_axis,
    down_range_axis,
    one_frame,
    place_text,
    unit_to_sonar,
    wrap_angle,
)
from .lattice import GroundLattice, ground_from_projection
from .passage import Passage, passage
from .place import Datum, Origin, Place, origin_of
from .runs import TrackBook, TrackPiece
from .track import (
    AspectGap,
    DoubtfulArc,
    Track,
)
from .views import (
    CoherentImage,
    View,
    ViewInfo,
    fit_target_to_focus,
    looks_at,
)

__all__ = [
    "SCENE_FRAME",
    "TWO_PI",
    "Acoustics",
    "AspectGap",
    "CoherentImage",
    "Datum",
    "DoubtfulArc",
    "FloatArray",
    "GroundGrid",
    "GroundLattice",
    "Origin",
    "Passage",
    "Place",
    "ShadowCamera",
    "Track",
    "TrackBook",
    "TrackPiece",
    "View",
    "ViewInfo",
    "aspects_of_step",
    "cross_range_axis",
    "down_range_axis",
    "fit_target_to_focus",
    "ground_from_projection",
    "looks_at",
    "one_frame",
    "origin_of",
    "passage",
    "place_text",
    "shadow_matrix",
    "unit_to_sonar",
    "view_ground_to_pixel",
    "wrap_angle",
]
