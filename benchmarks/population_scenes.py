"""Scenes drawn at random: shape families, poses, seabeds, tracks and faults, by half and number."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.shape.mesh import measure
from csas_shadow_ros.simulation import Bump, Faults, Patch, Profile, Scene, Seabed, SimulatedRun, simulate
from csas_shadow_ros.simulation.bodies import (
    Parts,
    bar,
    bounds_of,
    brick,
    convex,
    ellipsoid,
    frustum,
    ring,
    settled,
    transformed,
)
from csas_shadow_ros.simulation.targets import empty_mesh, join_bodies

DEVELOPMENT, TEST = "development", "test"
#: A third set, of families that neither half has: what the development half chose is tried here first.
VALIDATION = "validation"
HALVES = (DEVELOPMENT, TEST, VALIDATION)
#: Changes with what `draw` draws: rows of another one are of other scenes.
DRAWING = 2
#: Views every 6°, half an aperture: time goes with their number.
STEP_DEG = 6.0
#: The main body is at least so many cross-range cells wide: what is thinner leaves no shadow to speak of.
LEAST_CELLS = 2.0
#: Side of the largest image that is drawn.
MOST_PIXELS = 1408

Rng = np.random.Generator


# ---- shape families: each draws convex parts in units of its own, scaled to a drawn size afterwards


def _uniform(rng: Rng, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _box(rng: Rng) -> Parts:
    return [brick((1.0, _uniform(rng, 0.25, 0.9), _uniform(rng, 0.25, 0.7)))]


def _flat_box(rng: Rng) -> Parts:
    return [brick((1.0, _uniform(rng, 0.4, 1.0), _uniform(rng, 0.08, 0.2)))]


def _keg(rng: Rng) -> Parts:
    return [frustum(0.7, 0.7, _uniform(rng, 0.4, 1.0))]


def _pipe(rng: Rng) -> Parts:
    d = _uniform(rng, 0.06, 0.15)
    return [bar((-0.5, 0, d / 2), (0.5, 0, d / 2), d)]


def _cone(rng: Rng) -> Parts:
    return [frustum(1.0, _uniform(rng, 0.0, 0.6), _uniform(rng, 0.3, 0.8))]


def _sphere(_: Rng) -> Parts:
    return [ellipsoid((1.0, 1.0, 1.0))]


def _tyre(rng: Rng) -> Parts:
    return ring(1.0, _uniform(rng, 0.2, 0.36))


def _table(rng: Rng) -> Parts:
    w, h, t, leg = _uniform(rng, 0.5, 0.9), _uniform(rng, 0.35, 0.7), _uniform(rng, 0.08, 0.15), 0.08
    parts = [brick((1.0, w, t), (0, 0, h - t))]
    return parts + [
        brick((leg, leg, h - t), (sx * (0.5 - leg / 2), sy * (w - leg) / 2, 0))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]


def _stack(rng: Rng) -> Parts:
    w, h = _uniform(rng, 0.5, 0.9), _uniform(rng, 0.12, 0.3)
    upper = (_uniform(rng, 0.3, 0.6), _uniform(rng, 0.5, 0.9) * w, _uniform(rng, 0.15, 0.35))
    x = _uniform(rng, -0.5, 0.5) * (1.0 - upper[0])
    return [brick((1.0, w, h)), brick(upper, (x, 0, h))]


def _rock(rng: Rng) -> Parts:
    points = rng.standard_normal((26, 3))
    points *= (0.35 + 0.15 * rng.uniform(size=(26, 1))) / np.linalg.norm(points, axis=1)[:, None]
    points *= (1.0, _uniform(rng, 0.6, 1.0), _uniform(rng, 0.5, 0.9))
    return [convex(points)]


def _crate(rng: Rng) -> Parts:
    w, h, t = _uniform(rng, 0.5, 0.9), _uniform(rng, 0.3, 0.6), 0.06
    walls = [brick((1.0, t, h), (0, s * (w - t) / 2, 0)) for s in (-1, 1)]
    walls += [brick((t, w - 2 * t, h), (s * (1.0 - t) / 2, 0, 0)) for s in (-1, 1)]
    return [*walls, brick((1.0 - 2 * t, w - 2 * t, t))]


def _l_plan(rng: Rng) -> Parts:
    w, limb, h = _uniform(rng, 0.5, 0.9), _uniform(rng, 0.2, 0.35), _uniform(rng, 0.2, 0.5)
    return [
        brick((1.0, limb, h), (0, -(w - limb) / 2, 0)),
        brick((limb, w - limb, h), (-(1.0 - limb) / 2, limb / 2, 0)),
    ]


def _wedge(rng: Rng) -> Parts:
    w, h = _uniform(rng, 0.4, 0.9) / 2, _uniform(rng, 0.2, 0.5)
    low = [(x, y, 0.0) for x in (-0.5, 0.5) for y in (-w, w)]
    return [convex([*low, (-0.5, -w, h), (-0.5, w, h)])]


def _pole(rng: Rng) -> Parts:
    d = _uniform(rng, 0.12, 0.3)
    return [frustum(d, d, 1.0)]


def _drum(rng: Rng) -> Parts:
    d = _uniform(rng, 0.3, 0.65)
    return [bar((-0.5, 0, d / 2), (0.5, 0, d / 2), d, sections=40)]


def _dome(rng: Rng) -> Parts:
    ball = ellipsoid((1.0, 1.0, _uniform(rng, 0.5, 1.0)))
    return settled([ball], tilt_rad=0.0, about_rad=0.0, buried=0.5)


def _hexagon(rng: Rng) -> Parts:
    return [frustum(1.0, _uniform(rng, 0.8, 1.0), _uniform(rng, 0.25, 0.7), sections=6)]


def _flat_mine(rng: Rng) -> Parts:
    return [frustum(1.0, _uniform(rng, 0.5, 0.9), _uniform(rng, 0.12, 0.25))]


def _t_plan(rng: Rng) -> Parts:
    w, limb, h = _uniform(rng, 0.5, 0.9), _uniform(rng, 0.2, 0.35), _uniform(rng, 0.2, 0.5)
    return [brick((limb, w, h), (-(1.0 - limb) / 2, 0, 0)), brick((1.0 - limb, limb, h), (limb / 2, 0, 0))]


def _gable(rng: Rng) -> Parts:
    w, h = _uniform(rng, 0.4, 0.9) / 2, _uniform(rng, 0.2, 0.5)
    low = [(x, y, 0.0) for x in (-0.5, 0.5) for y in (-w, w)]
    return [convex([*low, (-0.5, 0.0, h), (0.5, 0.0, h)])]


def _tripod(rng: Rng) -> Parts:
    h, d, leg = _uniform(rng, 0.6, 1.0), _uniform(rng, 0.3, 0.6), _uniform(rng, 0.07, 0.12)
    parts = [frustum(d, d, 0.2 * h, centre=(0, 0, 0.8 * h))]
    for turn in np.radians((90.0, 210.0, 330.0)):
        out = np.array([math.cos(turn), math.sin(turn), 0.0])
        parts.append(bar(0.45 * out, 0.3 * d * out + (0, 0, 0.85 * h), leg))
    return parts


def _drums(rng: Rng) -> Parts:
    d = 0.3
    parts = [bar((-0.4, s * d / 2, d / 2), (0.4, s * d / 2, d / 2), d) for s in (-1, 1)]
    x, z = _uniform(rng, -0.1, 0.1), d / 2 + d * math.sqrt(0.75)
    return [*parts, bar((x - 0.4, 0, z), (x + 0.4, 0, z), d)]


def _hoop(rng: Rng) -> Parts:
    upright = trimesh.transformations.rotation_matrix(math.pi / 2, (1.0, 0.0, 0.0))
    return transformed(ring(1.0, _uniform(rng, 0.18, 0.3)), upright)


def _boulders(rng: Rng) -> Parts:
    parts = []
    for turn in rng.uniform(0, 2 * math.pi) + np.radians((0.0, 130.0, 240.0)):
        move = np.eye(4)
        move[:3, 3] = 0.3 * math.cos(turn), 0.3 * math.sin(turn), _uniform(rng, 0.25, 0.3)
        parts += transformed(_rock(rng), move)
    return parts


def _wreck(rng: Rng) -> Parts:
    """Make a hull in two pieces with ribs between, the bow pointed."""
    w, h = _uniform(rng, 0.25, 0.35), _uniform(rng, 0.15, 0.3)
    bow = convex(
        [(0.5, 0, 0), (0.5, 0, h), *((0.2, s * w * f / 2, z) for s in (-1, 1) for f, z in ((0.6, 0), (1, h)))]
    )
    stern = brick((0.3, w, _uniform(rng, 0.7, 1.3) * h), (-0.35, 0, 0))
    keel = brick((0.4, 0.08, 0.06))
    ribs = [brick((0.04, 0.04, 0.8 * h), (x, s * w / 2, 0)) for x in (-0.1, 0.05) for s in (-1, 1)]
    floors = [brick((0.04, w, 0.05), (x, 0, 0)) for x in (-0.1, 0.05)]
    return [bow, stern, keel, *ribs, *floors]


def _torpedo(rng: Rng) -> Parts:
    d = _uniform(rng, 0.12, 0.25)
    body = bar((-0.5, 0, d / 2), (0.5 - d / 2, 0, d / 2), d)
    nose = ellipsoid((d, d, d))
    nose.apply_translation((0.5 - d / 2, 0, d / 2))
    fins = [brick((0.12, 0.02, 1.4 * d), (-0.44, 0, 0)), brick((0.12, 1.4 * d, 0.02), (-0.44, 0, d / 2))]
    return [body, nose, *fins]


def _bollard(rng: Rng) -> Parts:
    d, h = _uniform(rng, 0.15, 0.3), _uniform(rng, 0.6, 1.0)
    return [frustum(0.6, 0.6, 0.15 * h), frustum(d, d, h, centre=(0, 0, 0.1 * h))]


def _beam(rng: Rng) -> Parts:
    w, h, t = _uniform(rng, 0.12, 0.25), _uniform(rng, 0.15, 0.3), 0.04
    return [brick((1.0, w, t)), brick((1.0, t, h), (0, 0, 0)), brick((1.0, w, t), (0, 0, h - t))]


def _pyramid(rng: Rng) -> Parts:
    w, h = _uniform(rng, 0.5, 1.0) / 2, _uniform(rng, 0.3, 0.8)
    return [convex([*((x, y, 0.0) for x in (-0.5, 0.5) for y in (-w, w)), (0.0, 0.0, h)])]


def _channel(rng: Rng) -> Parts:
    w, h, t = _uniform(rng, 0.4, 0.8), _uniform(rng, 0.25, 0.5), 0.08
    return [brick((1.0, w, t)), *(brick((1.0, t, h), (0, s * (w - t) / 2, 0)) for s in (-1, 1))]


def _egg(rng: Rng) -> Parts:
    return [ellipsoid((1.0, _uniform(rng, 0.5, 0.9), _uniform(rng, 0.4, 0.8)))]


def _bucket(rng: Rng) -> Parts:
    return [frustum(_uniform(rng, 0.5, 0.75), 0.9, _uniform(rng, 0.5, 0.9))]


def _barrel(rng: Rng) -> Parts:
    ends, belly = _uniform(rng, 0.3, 0.4) / 2, _uniform(rng, 0.4, 0.55) / 2
    turn = np.arange(20) * 2 * math.pi / 20
    circle = np.column_stack([np.zeros(20), np.cos(turn), np.sin(turn)])
    stations = [(ends, -0.5), (ends, 0.5), (belly, -0.15), (belly, 0.15)]
    return [convex(np.vstack([circle * radius + [x, 0, 0] for radius, x in stations]))]


def _steps(rng: Rng) -> Parts:
    w, h = _uniform(rng, 0.4, 0.9), _uniform(rng, 0.12, 0.25)
    return [brick((1 - 0.33 * n, w, h), (0.165 * n, 0, h * n)) for n in range(3)]


def _x_plan(rng: Rng) -> Parts:
    t, h = _uniform(rng, 0.18, 0.35), _uniform(rng, 0.15, 0.5)
    return [brick((1, t, h)), brick((t, _uniform(rng, 0.6, 1.0), h))]


def _upright(plan: NDArray[np.float64], height: float) -> Parts:
    return [convex(np.vstack([np.column_stack([plan, np.full(len(plan), z)]) for z in (0.0, height)]))]


def _half_disc(rng: Rng) -> Parts:
    height, turn = _uniform(rng, 0.2, 0.6), np.linspace(-math.pi / 2, math.pi / 2, 20)
    return _upright(0.5 * np.column_stack([np.cos(turn), np.sin(turn)]), height)


def _boat(rng: Rng) -> Parts:
    w, h = _uniform(rng, 0.3, 0.5) / 2, _uniform(rng, 0.15, 0.3)
    keel = [(x, s * 0.6 * w, 0) for x in (-0.45, 0.25) for s in (-1, 1)]
    deck = [(x, s * w, h) for x in (-0.5, 0.2) for s in (-1, 1)]
    return [convex([*keel, (0.35, 0, 0), *deck, (0.5, 0, h)]), brick((0.3, w, h * 0.8), (-0.25, 0, h))]


def _triangle(rng: Rng) -> Parts:
    height, across = _uniform(rng, 0.2, 0.7), _uniform(rng, 0.5, 0.9) / 2
    return _upright(np.array([(-0.5, -across), (0.5, -across), (0.0, across)]), height)


def _leaning_slab(rng: Rng) -> Parts:
    t, w, h = _uniform(rng, 0.1, 0.25) / 2, _uniform(rng, 0.4, 0.9) / 2, _uniform(rng, 0.4, 0.7)
    over = _uniform(rng, 0.1, 0.4)
    return [convex([(x + (over if z else 0), y, z) for x in (-t, t) for y in (-w, w) for z in (0.0, h)])]


def _mushroom(rng: Rng) -> Parts:
    h = _uniform(rng, 0.3, 0.6)
    stem = frustum(_uniform(rng, 0.25, 0.45), _uniform(rng, 0.25, 0.45), h)
    return [stem, frustum(1.0, _uniform(rng, 0.3, 1.0), _uniform(rng, 0.12, 0.25), centre=(0, 0, h))]


def _anchor(rng: Rng) -> Parts:
    d = _uniform(rng, 0.08, 0.14)
    rods = [((-0.5, 0, d), (0.5, 0, d)), ((0.35, -0.3, d), (0.35, 0.3, d)), ((0.5, 0, d), (0.5, 0, 0.45))]
    return [bar(start, stop, d) for start, stop in rods]


def _tower(rng: Rng) -> Parts:
    h = _uniform(rng, 0.12, 0.3)
    foot = frustum(1.0, _uniform(rng, 0.6, 1.0), h)
    size = [_uniform(rng, low, high) for low, high in ((0.3, 0.5), (0.2, 0.3), (0.3, 0.6))]
    return [foot, frustum(*size, centre=(_uniform(rng, -0.2, 0.2), 0, h))]


@dataclass(frozen=True)
class Family:
    """A family of shapes.

    Parameters
    ----------
    make : callable
        Draws convex parts, of any size.
    size_m : (float, float)
        Between which the largest extent is drawn, log-uniform.
    text : str
        What it is.
    """

    make: Callable[[Rng], Parts]
    size_m: tuple[float, float]
    text: str


FAMILIES: dict[str, dict[str, Family]] = {
    DEVELOPMENT: {
        "box": Family(_box, (0.2, 3.0), "box"),
        "flat_box": Family(_flat_box, (0.4, 4.0), "low wide box"),
        "keg": Family(_keg, (0.2, 2.0), "standing cylinder"),
        "pipe": Family(_pipe, (0.8, 4.0), "long lying cylinder"),
        "cone": Family(_cone, (0.3, 2.0), "cone, whole or truncated"),
        "sphere": Family(_sphere, (0.2, 1.5), "sphere"),
        "tyre": Family(_tyre, (0.4, 1.5), "ring that lies flat"),
        "table": Family(_table, (0.4, 2.0), "slab on four legs"),
        "stack": Family(_stack, (0.3, 3.0), "box on a slab"),
        "rock": Family(_rock, (0.2, 3.0), "rock, convex"),
        "crate": Family(_crate, (0.3, 3.0), "open box"),
        "l_plan": Family(_l_plan, (0.4, 3.0), "L plan"),
        "wedge": Family(_wedge, (0.3, 3.0), "slopes down to the seabed at one end"),
        "pole": Family(_pole, (0.1, 1.5), "pole"),
    },
    TEST: {
        "drum": Family(_drum, (0.2, 2.5), "lying cylinder"),
        "dome": Family(_dome, (0.3, 2.0), "dome"),
        "hexagon": Family(_hexagon, (0.2, 2.0), "six-sided prism"),
        "flat_mine": Family(_flat_mine, (0.3, 1.2), "flat mine"),
        "t_plan": Family(_t_plan, (0.4, 3.0), "T plan"),
        "gable": Family(_gable, (0.3, 3.0), "slopes down to the seabed on two sides"),
        "tripod": Family(_tripod, (0.4, 2.0), "round body on three legs"),
        "drums": Family(_drums, (0.4, 2.0), "three drums, one on two"),
        "hoop": Family(_hoop, (0.4, 1.5), "ring that stands"),
        "boulders": Family(_boulders, (0.4, 4.0), "three rocks that touch"),
        "wreck": Family(_wreck, (1.0, 4.0), "hull with a gap of ribs"),
        "torpedo": Family(_torpedo, (0.6, 4.0), "long cylinder with nose and fins"),
        "bollard": Family(_bollard, (0.1, 1.5), "post on a foot"),
        "beam": Family(_beam, (0.5, 4.0), "I beam"),
        "pyramid": Family(_pyramid, (0.3, 2.0), "pyramid"),
        "channel": Family(_channel, (0.3, 3.0), "open channel"),
    },
    VALIDATION: {
        "egg": Family(_egg, (0.3, 2.0), "ellipsoid"),
        "bucket": Family(_bucket, (0.3, 2.0), "round, wider at its top"),
        "barrel": Family(_barrel, (0.3, 2.0), "lying barrel"),
        "steps": Family(_steps, (0.3, 2.0), "three steps"),
        "x_plan": Family(_x_plan, (0.3, 2.0), "two crossing beams"),
        "half_disc": Family(_half_disc, (0.3, 2.0), "half a disc"),
        "boat": Family(_boat, (0.3, 2.0), "boat with a cabin"),
        "triangle": Family(_triangle, (0.3, 2.0), "three-sided prism"),
        "leaning_slab": Family(_leaning_slab, (0.3, 2.0), "slab that leans over"),
        "mushroom": Family(_mushroom, (0.3, 2.0), "plate on a stem"),
        "anchor": Family(_anchor, (0.3, 2.0), "bars, one of them up"),
        "tower": Family(_tower, (0.3, 2.0), "tower on a wide foot"),
    },
}

#: What may be added to a plain scene, with its weight. How many are is drawn too (`COMPLICATION_SHARES`).
COMPLICATIONS = {
    "buried": 1.5,
    "tilted": 1.0,
    "bodies": 1.5,
    "clutter": 1.0,
    "texture": 1.0,
    "patches": 1.0,
    "step": 1.0,
    "ripples": 1.0,
    "relief": 1.0,
    "slope": 0.8,
    "offset": 0.6,
    "ellipse": 0.5,
    "spiral": 0.5,
    "wobble": 0.8,
    "drift": 0.7,
    "radial": 0.7,
    "arc": 1.0,
    "cropped": 0.8,
    "phase": 0.5,
}
COMPLICATION_TEXT = {
    "buried": "10 to 70 % of the height is under the seabed",
    "tilted": "3° to 20° about any horizontal axis, its lower side in the seabed",
    "bodies": "one or two further bodies, half as large to as large, a gap of 0.15 to 1 length beside it",
    "clutter": "two to five rocks of 6 to 18 % of the body's size, which need not be found",
    "texture": "smooth random level, 0.5 to 3 dB rms",
    "patches": "one to four ellipses, -14 to +8 dB",
    "step": "a straight edge near the middle, 3 to 12 dB",
    "ripples": "3 to 10 cells long, slopes of 2° to 11°",
    "relief": "one to four pits, and mounds too flat to cast a shadow",
    "slope": "the seabed tilted by 0.5° to 4° (a third of the grazing angle) against the track's level",
    "offset": "the circle's centre 1 to 15 % of its radius off the image's",
    "ellipse": "semi-axes 1 to 12 % off the radius",
    "spiral": "up to 6 % of the radius nearer or farther at the end",
    "wobble": "range and height vary by 0.1 to 1 % of the height",
    "drift": "0.3 to 3 cells of position error over the circle",
    "radial": "every view 0.3 to 1.5 cells too near or too far",
    "arc": "20° to 120° missing",
    "cropped": "an image of 45 to 80 % of the side that body and shadow need",
    "phase": "residual phase error of 0.2 to 1.5 rad",
}
COMPLICATION_SHARES = (0.25, 0.35, 0.25, 0.15)
#: What a seabed without objects is like, in turn; each may carry faults of the track besides.
SEABEDS = ("texture", "patches", "ripples", "relief", "step", "texture")
SEABED_FAULTS = ("offset", "ellipse", "spiral", "wobble", "drift", "radial", "arc", "slope", "phase")
#: Of five scenes, these have objects.
_OBJECT_SCENES = (0, 1, 3)


# ---- a scene


@dataclass(frozen=True)
class Body:
    """One body: its family, what is random in its shape, and how it lies.

    Parameters
    ----------
    family : str
        Name in `FAMILIES`, of either half.
    seed : int
        Of its shape.
    size_m : float
        Its largest extent before it is tilted and sunk.
    heading_deg, tilt_deg, about_deg, buried
        Pose: see `simulation.bodies.settled`.
    place_m : (float, float)
        Middle (x, y) of its plan.
    """

    family: str
    seed: int
    size_m: float
    heading_deg: float = 0.0
    tilt_deg: float = 0.0
    about_deg: float = 0.0
    buried: float = 0.0
    place_m: tuple[float, float] = (0.0, 0.0)

    def mesh(self) -> trimesh.Trimesh:
        """Return what of it is above the seabed, in the scene frame."""
        mesh = _lying(replace(self, place_m=(0.0, 0.0))).copy()
        mesh.apply_translation((*self.place_m, 0.0))
        return mesh


@lru_cache(maxsize=64)
def _lying(body: Body) -> trimesh.Trimesh:
    """Make a body at the origin; drawing a scene asks for the same few again and again."""
    family = next(half[body.family] for half in FAMILIES.values() if body.family in half)
    parts = family.make(np.random.default_rng([body.seed, 0xB0]))
    scale = np.diag([body.size_m / float(np.ptp(bounds_of(parts), axis=0).max())] * 3 + [1.0])
    left = settled(
        transformed(parts, scale),
        tilt_rad=math.radians(body.tilt_deg),
        about_rad=math.radians(body.about_deg),
        buried=body.buried,
    )
    turn = trimesh.transformations.rotation_matrix(math.radians(body.heading_deg), (0.0, 0.0, 1.0))
    return join_bodies(transformed(left, turn))


@dataclass(frozen=True)
class SceneSpec:
    """A scene as it was drawn: everything that is needed to make it again.

    Parameters
    ----------
    half, index
        What it was drawn by.
    complications : tuple of str
        What of `COMPLICATIONS` it has.
    bodies, clutter : tuple of Body
        Bodies that are to be found, the main one first; small ones that need not be.
    radius_m, grazing_deg : float
        The sonar's circle.
    pixels, spacing_m, bandwidth : int, float, float
        Image, and bandwidth over centre frequency.
    contrast_db, echo_db : float
        Levels; echo -100: none.
    clockwise, start_aspect_deg
        How the sonar goes round.
    faults : Faults
        What is wrong.
    bed : Seabed
        What the seabed is like.
    voxel_m, oversampling : float
        What the chain is told.
    seed : int
        Of speckle.
    """

    half: str
    index: int
    complications: tuple[str, ...]
    bodies: tuple[Body, ...]
    clutter: tuple[Body, ...]
    radius_m: float
    grazing_deg: float
    pixels: int
    spacing_m: float
    bandwidth: float
    contrast_db: float
    echo_db: float
    clockwise: bool
    start_aspect_deg: float
    faults: Faults
    bed: Seabed
    voxel_m: float
    oversampling: float
    seed: int

    @property
    def name(self) -> str:
        """Half and number."""
        return f"{self.half} {self.index}"

    @property
    def family(self) -> str:
        """Family of the main body; none: ``seabed``."""
        return self.bodies[0].family if self.bodies else "seabed"

    @property
    def height_m(self) -> float:
        """Height of the sonar over the seabed."""
        return self.radius_m * math.tan(math.radians(self.grazing_deg))

    def profile(self) -> Profile:
        """Return image, circle and band."""
        centre = _centre_frequency_hz(self.spacing_m, self.bandwidth, self.grazing_deg)
        return Profile(
            name="population",
            rows=self.pixels,
            cols=self.pixels,
            spacing_m=self.spacing_m,
            radius_m=self.radius_m,
            height_m=self.height_m,
            centre_frequency_hz=centre,
            bandwidth_hz=self.bandwidth * centre,
            block_deg=1.0,
            edge_m=4.0 * self.spacing_m,
            pose_step_deg=1.0,
        )

    @property
    def cell_m(self) -> float:
        """Cross-range resolution cell of a view of 12°."""
        return _cell_m(self.spacing_m, self.bandwidth)

    def parameters(self) -> PipelineParameters:
        """Return what the chain is told."""
        return PipelineParameters(
            sub_aperture=SubApertureParameters(step_deg=STEP_DEG, oversampling=self.oversampling),
            carving=CarvingParameters(voxel_size_m=self.voxel_m),
        )

    def meshes(self) -> list[trimesh.Trimesh]:
        """Return each body of the truth."""
        return [body.mesh() for body in self.bodies]

    def scene(self) -> Scene:
        """Return what lies on the seabed: the first body is the target, all others are decor."""
        every = [body.mesh() for body in (*self.bodies, *self.clutter)]
        if not self.bodies:
            return Scene("seabed", empty_mesh(), empty_mesh(), (), (0.0, 0.0, 0.0), (0.0, 0.0), 0.0)
        target, rest = every[0], every[1:]
        size = target.extents
        return Scene(
            self.family,
            target,
            join_bodies(rest) if rest else empty_mesh(),
            (),
            (float(size[0]), float(size[1]), float(size[2])),
            self.bodies[0].place_m,
            math.radians(self.bodies[0].heading_deg),
        )

    def simulate(self) -> SimulatedRun:
        """Simulate it, in one thread."""
        return simulate(
            self.profile(),
            self.scene(),
            seed=self.seed,
            faults=self.faults,
            echo_db=self.echo_db,
            bed=self.bed,
            clockwise=self.clockwise,
            start_aspect_deg=self.start_aspect_deg,
            workers=1,
        )


#: Highest ground wavenumber over that of the lattice: as in profile `standard`.
_BAND_END = 0.9


def _centre_frequency_hz(spacing_m: float, bandwidth: float, grazing_deg: float) -> float:
    highest = _BAND_END * math.pi / spacing_m  # = 4π f (1 + b/2) cos ψ / c
    return highest * 1500.0 / (4.0 * math.pi * math.cos(math.radians(grazing_deg)) * (1.0 + bandwidth / 2.0))


def _cell_m(spacing_m: float, bandwidth: float) -> float:
    middle = _BAND_END * math.pi / spacing_m / (1.0 + bandwidth / 2.0)
    return 2.0 * math.pi / (middle * math.radians(SubApertureParameters().aperture_deg))


def shadow_length_m(height_m: float, radius_m: float, sonar_m: float) -> float:
    """Return how far behind a point of a height its shadow reaches, on a flat seabed."""
    return height_m * radius_m / max(sonar_m - height_m, 1e-9)


def draw(half: str, index: int) -> SceneSpec:
    """Draw a scene.

    Parameters
    ----------
    half : str
        ``development``, ``test`` or ``validation``.
    index : int
        Number of the scene. Of five, three have objects; families follow one another in turn.
    """
    if half not in HALVES:
        raise ValueError(f"half is {half!r}; expected one of: {', '.join(HALVES)}")
    rng = np.random.default_rng([HALVES.index(half), index, 1, 0x909])
    turn, place = divmod(index, 5)
    with_object = place in _OBJECT_SCENES
    if with_object:
        count = int(rng.choice(len(COMPLICATION_SHARES), p=COMPLICATION_SHARES))
        weights = np.array(list(COMPLICATIONS.values()))
        chosen = rng.choice(list(COMPLICATIONS), count, replace=False, p=weights / weights.sum())
        bodies, clutter = _draw_bodies(rng, half, 3 * turn + _OBJECT_SCENES.index(place), chosen)
    else:
        bed = SEABEDS[(2 * turn + (place == 4)) % len(SEABEDS)]
        more = rng.choice([*SEABEDS[:5], *SEABED_FAULTS], int(rng.integers(0, 3)), replace=False)
        chosen = np.array([bed, *(c for c in more if c != bed)])
        bodies, clutter = (), ()
    complications = tuple(sorted(str(c) for c in chosen))
    return _draw_run(rng, half, index, complications, bodies, clutter)


def _draw_body(rng: Rng, family: str, size_m: float, chosen: Iterable[str]) -> Body:
    tilted = "tilted" in chosen
    buried = _uniform(rng, 0.1, 0.7) if "buried" in chosen else _uniform(rng, 0.05, 0.25) if tilted else 0.0
    return Body(
        family,
        int(rng.integers(1 << 31)),
        size_m,
        _uniform(rng, 0.0, 360.0),
        _uniform(rng, 3.0, 20.0) if tilted else 0.0,
        _uniform(rng, 0.0, 360.0),
        buried,
    )


def _moved(body: Body, x: float, y: float) -> Body:
    return replace(body, place_m=(float(x), float(y)))


def _reach_m(body: Body) -> float:
    low, high = body.mesh().bounds
    return 0.5 * math.hypot(*(high - low)[:2])


def _draw_bodies(
    rng: Rng, half: str, number: int, chosen: Iterable[str]
) -> tuple[tuple[Body, ...], tuple[Body, ...]]:
    chosen = list(chosen)
    names = list(FAMILIES[half])
    family = names[number % len(names)]
    low, high = FAMILIES[half][family].size_m
    size = _log_uniform(rng, low, high)
    main = _draw_body(rng, family, size, chosen)
    off = 0.1 * size if rng.uniform() < 0.5 else size
    main = _moved(main, _uniform(rng, -off, off), _uniform(rng, -off, off))
    taken = [(main.place_m, _reach_m(main))]

    def beside(body: Body, gap: tuple[float, float]) -> Body:
        """Put a body beside those that are there, so far from the main one."""
        reach = _reach_m(body)
        for attempt in range(50):
            away = taken[0][1] + reach + _uniform(rng, *gap) * size * (1.0 + attempt / 10.0)
            turn = _uniform(rng, 0.0, 2.0 * math.pi)
            x, y = main.place_m[0] + away * math.cos(turn), main.place_m[1] + away * math.sin(turn)
            if all(math.hypot(x - px, y - py) > reach + r + 0.05 * size for (px, py), r in taken):
                break
        taken.append(((x, y), reach))
        return _moved(body, x, y)

    bodies, clutter = [main], []
    if "bodies" in chosen:
        for _ in range(int(rng.integers(1, 3))):
            other = names[int(rng.integers(len(names)))]
            body = _draw_body(rng, other, _uniform(rng, 0.5, 1.0) * size, ())
            bodies.append(beside(body, (0.15, 1.0)))
    if "clutter" in chosen:
        kind = {DEVELOPMENT: "rock", TEST: "boulders", VALIDATION: "egg"}[half]
        for _ in range(int(rng.integers(2, 6))):
            body = _draw_body(rng, kind, _uniform(rng, 0.06, 0.18) * size, ())
            clutter.append(beside(body, (0.1, 1.2)))
    return tuple(bodies), tuple(clutter)


def _draw_view(
    rng: Rng, body: Body, bounds: NDArray[np.float64], grazing: float, bandwidth: float
) -> tuple[float, float, float, float]:
    """Draw the circle's radius (m), grazing (deg), half side of the image and spacing of its pixels (m).

    10 to 40 cells along the body and at least two across it, as far as the image may have pixels for it; what
    is too thin for its long shadow then is seen from higher up.
    """
    size = body.size_m
    top = float(bounds[:, 1, 2].max())
    radius = max(_log_uniform(rng, 20.0, 150.0), 8.0 * size, 4.0 * top / math.tan(math.radians(grazing)))
    corners = np.abs(bounds[:, :, :2]).max(axis=1)

    def needed_m(grazing_deg: float) -> float:
        """Return half of the side that bodies and shadows need."""
        sonar = radius * math.tan(math.radians(grazing_deg))
        return max(
            math.hypot(*corner) + shadow_length_m(b[1, 2], radius + size, sonar)
            for corner, b in zip(corners, bounds, strict=True)
        )

    cell = size / _log_uniform(rng, 10.0, 40.0)
    across = measure(body.mesh()).width_m / LEAST_CELLS
    cell = min(cell, across)
    spacing = cell / _cell_m(1.0, bandwidth)
    coarsest = across / _cell_m(1.0, bandwidth)
    while 2.0 * needed_m(grazing) > (MOST_PIXELS - 64) * coarsest and grazing < 35.0:
        grazing = min(grazing + 1.0, 35.0)
    return radius, grazing, needed_m(grazing) + 3.0 * cell, spacing


def _draw_run(
    rng: Rng,
    half: str,
    index: int,
    complications: tuple[str, ...],
    bodies: tuple[Body, ...],
    clutter: tuple[Body, ...],
) -> SceneSpec:
    grazing = _uniform(rng, 6.0, 35.0)
    bandwidth = _uniform(rng, 0.25, 0.45)
    if bodies:
        size = bodies[0].size_m
        bounds = np.array([body.mesh().bounds for body in (*bodies, *clutter)])
        radius, grazing, half_side, spacing = _draw_view(rng, bodies[0], bounds, grazing, bandwidth)
        if "cropped" in complications:
            half_side *= _uniform(rng, 0.45, 0.8)
    else:
        size = _log_uniform(rng, 0.2, 3.0)
        radius = max(_log_uniform(rng, 20.0, 150.0), 12.0 * size)
        half_side = _uniform(rng, 1.5, 3.0) * size
        spacing = 2.0 * half_side / 704.0
    pixels = int(np.clip(64 * math.ceil(2.0 * half_side / spacing / 64.0), 448, MOST_PIXELS))
    spacing = 2.0 * half_side / pixels
    cell = _cell_m(spacing, bandwidth)
    # The default where it suits the sonar; else in the proportion to a cell that it has in `standard`.
    voxel = 0.02 if 0.016 <= 0.65 * cell <= 0.026 else float(f"{0.65 * cell:.2g}")
    contrast = _uniform(rng, 4.0, 18.0)
    return SceneSpec(
        half,
        index,
        complications,
        bodies,
        clutter,
        radius,
        grazing,
        pixels,
        spacing,
        bandwidth,
        contrast,
        -100.0 if rng.uniform() < 0.2 else _uniform(rng, 0.0, 20.0),
        bool(rng.uniform() < 0.5),
        _uniform(rng, 0.0, 360.0),
        _draw_faults(rng, complications, contrast, radius, grazing, cell),
        _draw_bed(rng, complications, bodies, clutter, half_side, size, cell, grazing),
        voxel,
        float(rng.choice([1.5, 1.5, 1.5, 2.0, 3.0])),
        int(rng.integers(1 << 31)),
    )


def _draw_faults(
    rng: Rng, chosen: Sequence[str], contrast_db: float, radius_m: float, grazing_deg: float, cell_m: float
) -> Faults:
    def of(name: str, value: float) -> float:
        return value if name in chosen else 0.0  # drawn in any case: what follows does not depend on it

    turn = _uniform(rng, 0.0, 2.0 * math.pi)
    offset = of("offset", _uniform(rng, 0.01, 0.15) * radius_m)
    drift = of("drift", _uniform(rng, 0.3, 3.0) * cell_m)
    start, width = _uniform(rng, 0.0, 360.0), _uniform(rng, 20.0, 120.0)
    return Faults(
        contrast_db=contrast_db,
        track_wobble_m=of(
            "wobble", _uniform(rng, 0.001, 0.01) * radius_m * math.tan(math.radians(grazing_deg))
        ),
        missing_arcs_deg=((start, start + width),) if "arc" in chosen else (),
        phase_error_rad=of("phase", _uniform(rng, 0.2, 1.5)),
        track_offset_m=(offset * math.cos(turn), offset * math.sin(turn)),
        ellipse=of("ellipse", _uniform(rng, 0.01, 0.12)),
        ellipse_deg=_uniform(rng, 0.0, 180.0),
        spiral_m=of("spiral", _uniform(rng, -0.06, 0.06) * radius_m),
        tilt_deg=of("slope", _uniform(rng, 0.5, min(4.0, grazing_deg / 3.0))),
        tilt_towards_deg=_uniform(rng, 0.0, 360.0),
        drift_m=(drift * math.cos(turn), drift * math.sin(turn)),
        radial_shift_m=of("radial", float(rng.choice([-1.0, 1.0])) * _uniform(rng, 0.3, 1.5) * cell_m),
    )


def _draw_bed(
    rng: Rng,
    chosen: Sequence[str],
    bodies: Sequence[Body],
    clutter: Sequence[Body],
    half_side_m: float,
    size_m: float,
    cell_m: float,
    grazing_deg: float,
) -> Seabed:
    seed = int(rng.integers(1 << 31))
    patches, bumps = [], []
    for _ in range(int(rng.integers(1, 5))):
        radii = _uniform(rng, 0.2, 0.9) * size_m, _uniform(rng, 0.2, 0.9) * size_m
        centre = rng.uniform(-0.8, 0.8, 2) * half_side_m
        level = _uniform(rng, -14.0, 8.0)
        patches.append(
            Patch(
                (float(centre[0]), float(centre[1])),
                radii,
                _uniform(rng, 0.0, 180.0),
                level,
                _uniform(rng, 0.0, 0.5),
            )
        )
    taken = [(body.place_m, _reach_m(body)) for body in (*bodies, *clutter)]
    for _ in range(int(rng.integers(1, 5))):
        radius = _uniform(rng, 0.2, 0.7) * size_m
        # A mound may not be steep enough to cast a shadow: it would be an object. A pit may.
        steepest = 0.7 * math.tan(math.radians(grazing_deg)) * 2.0 / math.pi
        pit = not bumps or rng.uniform() < 0.5
        height = -_uniform(rng, 0.04, 0.25) if pit else _uniform(rng, 0.2, 1.0) * steepest
        height *= radius
        x, y = (float(v) for v in rng.uniform(-0.8, 0.8, 2) * half_side_m)
        if all(math.hypot(x - px, y - py) > r + 1.05 * radius for (px, py), r in taken):
            bumps.append(Bump((x, y), radius, height))
    step = float(rng.choice([-1.0, 1.0])) * _uniform(rng, 3.0, 12.0)
    length = _uniform(rng, 3.0, 10.0) * cell_m
    return Seabed(
        seed=seed,
        patches=tuple(patches) if "patches" in chosen else (),
        step_db=step if "step" in chosen else 0.0,
        step_deg=_uniform(rng, 0.0, 360.0),
        step_m=_uniform(rng, -0.3, 0.3) * half_side_m,
        texture_db=_uniform(rng, 0.5, 3.0) if "texture" in chosen else 0.0,
        texture_m=_uniform(rng, 2.0, 10.0) * cell_m,
        ripple_m=_uniform(rng, 0.005, 0.03) * length if "ripples" in chosen else 0.0,
        ripple_length_m=length,
        ripple_deg=_uniform(rng, 0.0, 180.0),
        bumps=tuple(bumps) if "relief" in chosen else (),
    )
