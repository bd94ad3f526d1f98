"""How the chain does on scenes drawn at random, rather than on targets that it was made with.

A scene is drawn from stated distributions (`draw`) by its half and its number alone: shape, size, pose,
seabed, track, faults, sonar. The **development** half and the **test** half share no shape family: the test
half is run once, at the end of a change, and nobody looks into it while working::

    python benchmarks/population.py --half development --scenes 40 --workers 2 --out FOLDER

Every scene goes through the whole automatic chain with default parameters, as ``csas-shadow run`` takes it;
only what a user sets by the sonar (voxel) or by the time there is (aspect step) is set. FOLDER/scenes.jsonl
takes a line as each scene is done, and a run that was interrupted goes on. The images are small, 448 to 1280
pixels: a scene takes 5 to 15 s on one core.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from accuracy import code_fingerprint, lattice_over

from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.mesh import measure
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import Result, run
from csas_shadow_ros.core.volume import Volume, VoxelGrid
from csas_shadow_ros.process import refuse_contradictions
from csas_shadow_ros.simulation import (
    Bump,
    Faults,
    Patch,
    Profile,
    Scene,
    Seabed,
    SimulatedRun,
    iou,
    shadow_hull,
    simulate,
    voxelise_truth,
)
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

ROOT = Path(__file__).resolve().parents[1]
DEVELOPMENT, TEST = "development", "test"
HALVES = (DEVELOPMENT, TEST)
#: Changes with what `draw` draws: rows of another one are of other scenes.
DRAWING = 1

SIZES = ("length_m", "width_m", "height_m")
#: Views every 6°, half an aperture: time goes with their number.
STEP_DEG = 6.0
#: Aspects whose silhouettes make the shadow hull.
HULL_VIEWS = 120
SIZE_TOLERANCE = 0.05
#: What the bounds on found objects are asked of.
LEAST_CONTRAST_DB, LEAST_SHADOW_CELLS = 6.0, 3.0

# What issue and page ask for.
MEDIAN_IOU, TENTH_IOU = 0.92, 0.80
SIZE_SHARE = 0.95
COVERAGE = (0.92, 0.99)
HALF_WIDTH = 0.03
MOST_PHANTOMS = 1
MOST_MISSED, MOST_UNFLAGGED = 0.02, 0.02

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


def _sphere(rng: Rng) -> Parts:
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
        family = next(half[self.family] for half in FAMILIES.values() if self.family in half)
        parts = family.make(np.random.default_rng([self.seed, 0xB0]))
        scale = np.diag([self.size_m / float(np.ptp(bounds_of(parts), axis=0).max())] * 3 + [1.0])
        left = settled(
            transformed(parts, scale),
            tilt_rad=math.radians(self.tilt_deg),
            about_rad=math.radians(self.about_deg),
            buried=self.buried,
        )
        pose = trimesh.transformations.rotation_matrix(math.radians(self.heading_deg), (0.0, 0.0, 1.0))
        pose[:2, 3] = self.place_m
        return join_bodies(transformed(left, pose))


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
        ``development`` or ``test``.
    index : int
        Number of the scene. Of five, three have objects; families follow one another in turn.
    """
    if half not in HALVES:
        raise ValueError(f"half is {half!r}; expected one of: {', '.join(HALVES)}")
    rng = np.random.default_rng([HALVES.index(half), index, DRAWING, 0x909])
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


def _draw_body(rng: Rng, half: str, family: str, size_m: float, chosen: Iterable[str]) -> Body:
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
    return Body(**{**asdict(body), "place_m": (float(x), float(y))})


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
    main = _draw_body(rng, half, family, size, chosen)
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
            body = _draw_body(rng, half, other, _uniform(rng, 0.5, 1.0) * size, ())
            bodies.append(beside(body, (0.15, 1.0)))
    if "clutter" in chosen:
        kind = "rock" if half == DEVELOPMENT else "boulders"
        for _ in range(int(rng.integers(2, 6))):
            body = _draw_body(rng, half, kind, _uniform(rng, 0.06, 0.18) * size, ())
            clutter.append(beside(body, (0.1, 1.2)))
    return tuple(bodies), tuple(clutter)


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
        top = float(bounds[:, 1, 2].max())
        radius = max(_log_uniform(rng, 20.0, 150.0), 8.0 * size, 4.0 * top / math.tan(math.radians(grazing)))
        sonar = radius * math.tan(math.radians(grazing))
        corners = np.abs(bounds[:, :, :2]).max(axis=1)
        half_side = max(
            math.hypot(*corner) + shadow_length_m(b[1, 2], radius + size, sonar)
            for corner, b in zip(corners, bounds, strict=True)
        )
        # 8 to 28 cells along the body, as far as the image may have pixels for it.
        cell = size / _log_uniform(rng, 8.0, 28.0)
        spacing = cell / _cell_m(1.0, bandwidth)
        half_side += 3.0 * cell
        if "cropped" in complications:
            half_side *= _uniform(rng, 0.45, 0.8)
    else:
        size = _log_uniform(rng, 0.2, 3.0)
        radius = max(_log_uniform(rng, 20.0, 150.0), 12.0 * size)
        half_side = _uniform(rng, 1.5, 3.0) * size
        spacing = 2.0 * half_side / 704.0
        top = 0.0
    pixels = int(np.clip(64 * math.ceil(2.0 * half_side / spacing / 64.0), 448, 1280))
    spacing = 2.0 * half_side / pixels
    cell = _cell_m(spacing, bandwidth)
    # The default where it suits the sonar; else in the proportion to a cell that it has in `standard`.
    voxel = 0.02 if 0.012 <= 0.65 * cell <= 0.03 else float(f"{0.65 * cell:.2g}")
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
        height = -_uniform(rng, 0.04, 0.25) if rng.uniform() < 0.5 else _uniform(rng, 0.2, 1.0) * steepest
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


# ---- scores


@dataclass(frozen=True)
class BodyScore:
    """How one body of the truth came out.

    Parameters
    ----------
    family : str
        Its family.
    shadow_cells : float
        Length of its shadow in cross-range cells.
    hull_vs_truth : float
        IoU of its shadow hull with it.
    true_size : dict
        `SIZES` of what is above the seabed, measured as the package measures.
    found : bool
        Whether an object covers it.
    merged : bool
        Whether that object covers another body too.
    iou_hull, iou_truth : float
        Of that object's voxels; 0 if there is none.
    size, intervals : dict
        Of that object.
    """

    family: str
    shadow_cells: float
    hull_vs_truth: float
    true_size: dict[str, float]
    found: bool = False
    merged: bool = False
    iou_hull: float = 0.0
    iou_truth: float = 0.0
    size: dict[str, float] = field(default_factory=dict)
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)

    def within(self, name: str, voxel_m: float) -> bool:
        """Return whether an extent is within 5 % or one voxel."""
        return name in self.size and abs(self.size[name] - self.true_size[name]) <= max(
            SIZE_TOLERANCE * self.true_size[name], voxel_m
        ) * (1.0 + 1e-9)

    def holds(self, name: str) -> bool | None:
        """Return whether the interval of an extent holds the truth; None if there is no interval."""
        if name not in self.intervals:
            return None
        low, high = self.intervals[name]
        return low <= self.true_size[name] <= high


@dataclass(frozen=True)
class Row:
    """What a scene came to.

    Parameters
    ----------
    half, index, family, complications
        Which scene.
    contrast_db, echo_db, grazing_deg, radius_m, size_m, cell_m, voxel_m : float
        What it was like; size 0: no object.
    verdict, quality, reasons, notices, refused
        What the chain said of it.
    phantoms : tuple
        (x, y) and (length, width, height) of each object found where there is none.
    objects : int
        How many were found.
    bodies : tuple of BodyScore
        One for each body of the truth.
    seconds : float
        Wall time, simulation included.
    """

    half: str
    index: int
    family: str
    complications: tuple[str, ...]
    contrast_db: float
    echo_db: float
    grazing_deg: float
    radius_m: float
    size_m: float
    cell_m: float
    voxel_m: float
    verdict: str = "no object"
    quality: str = "good"
    reasons: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    refused: str = ""
    phantoms: tuple[tuple[float, ...], ...] = ()
    objects: int = 0
    bodies: tuple[BodyScore, ...] = ()
    seconds: float = 0.0

    @property
    def flagged(self) -> bool:
        """Whether the result says that it is not to be relied on."""
        return bool(self.refused) or self.verdict == "undecided" or self.quality != "good"

    @property
    def assessable(self) -> bool:
        """Whether the bounds on found objects are asked of it: contrast, and shadows in the image."""
        return self.contrast_db >= LEAST_CONTRAST_DB and "cropped" not in self.complications

    @property
    def name(self) -> str:
        """Half and number."""
        return f"{self.half} {self.index}"

    def wrong(self) -> bool:
        """Return whether an extent is off by more than its interval, and by more than 5 % and a voxel."""
        return any(
            body.found and not body.within(name, self.voxel_m) and not body.holds(name)
            for body in self.bodies
            for name in SIZES
        )

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Row:
        """Make a row of a line of scenes.jsonl."""
        known = {k: v for k, v in values.items() if k in cls.__dataclass_fields__}
        for name in ("complications", "reasons", "notices"):
            known[name] = tuple(known[name])
        known["phantoms"] = tuple(tuple(p) for p in known["phantoms"])
        known["bodies"] = tuple(
            BodyScore(**{**b, "intervals": {k: (v[0], v[1]) for k, v in b["intervals"].items()}})
            for b in known["bodies"]
        )
        return cls(**known)


class TrueBody:
    """A body of the truth on any lattice that is asked for.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        What of it is above the seabed, scene frame.
    sonar_m : ndarray, shape (n, 3)
        True positions of the sonar.
    voxel_m : float
        Edge of a voxel.
    """

    def __init__(self, mesh: trimesh.Trimesh, sonar_m: NDArray[np.float64], voxel_m: float) -> None:
        self.mesh = mesh
        self._sonar = sonar_m[:: max(1, len(sonar_m) // HULL_VIEWS)]
        # Much finer than a voxel: the hull may be too large by it.
        self._spacing = voxel_m / 8.0
        self._made: dict[Volume, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {}

    def on(self, volume: Volume) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return (hull, truth)."""
        if volume not in self._made:
            hull = shadow_hull(self.mesh, self._sonar, volume, spacing_m=self._spacing)
            self._made[volume] = hull, voxelise_truth(self.mesh, volume)
        return self._made[volume]

    def own_volume(self, voxel_m: float) -> Volume:
        """Return a lattice that holds it and its hull."""
        low, high = self.mesh.bounds
        room = 0.25 * float((high - low).max()) + 4.0 * voxel_m
        middle, size = (low + high) / 2.0, high - low + 2.0 * room
        return Volume.around(
            (float(middle[0]), float(middle[1])),
            (float(size[0]), float(size[1]), float(high[2] + room)),
            voxel_m,
        )

    def overlap(self, grid: VoxelGrid) -> float:
        """Return the share of the smaller of a grid's object and this body's hull that both have."""
        if not self.near(grid):
            return 0.0
        occupied, hull, truth = self.compared(grid)
        return float((occupied & (hull | truth)).sum() / max(1, min(occupied.sum(), (hull | truth).sum())))

    def near(self, grid: VoxelGrid) -> bool:
        """Return whether a grid's volume meets the body's bounds."""
        d = grid.volume.voxel_size_m
        low = np.asarray(grid.volume.origin_m) - d / 2.0
        high = low + np.asarray(grid.volume.size_m)
        return bool(np.all(low < self.mesh.bounds[1]) and np.all(high > self.mesh.bounds[0]))

    def compared(self, grid: VoxelGrid) -> tuple[NDArray[np.bool_], ...]:
        """Return (object, hull, truth) on a grid's lattice, widened to hold the body."""
        wide, inside = lattice_over(grid.volume, self.mesh)
        occupied = np.zeros(wide.shape, bool)
        occupied[inside] = grid.occupied
        return (occupied, *self.on(wide))

    def sizes(self, heading_rad: float | None = None) -> dict[str, float]:
        """Return `SIZES` as the package measures them.

        A plan may have several rectangles round it that are as small to a few per cent, at other headings:
        where that of the heading that was found is one of them, its sides are the ones to compare with.
        """
        found = measure(self.mesh)
        sizes = {name: float(getattr(found, name)) for name in SIZES}
        if heading_rad is not None:
            along = np.array([math.cos(heading_rad), math.sin(heading_rad)])
            plan = np.asarray(self.mesh.vertices)[:, :2]
            sides = float(np.ptp(plan @ along)), float(np.ptp(plan @ [-along[1], along[0]]))
            if sides[0] * sides[1] <= 1.02 * sizes["length_m"] * sizes["width_m"]:
                sizes["length_m"], sizes["width_m"] = max(sides), min(sides)
        return {name: round(value, 6) for name, value in sizes.items()}


#: An object is of a body where it shares this much of the smaller of both.
_LEAST_OVERLAP = 0.1


def score(spec: SceneSpec, sonar_m: NDArray[np.float64], result: Result) -> tuple[list[BodyScore], list[Any]]:
    """Compare what was found with the truth.

    Returns
    -------
    bodies : list of BodyScore
        One for each body of the truth.
    phantoms : list
        Objects found where there is neither body nor clutter.
    """
    truths = [TrueBody(mesh, sonar_m, spec.voxel_m) for mesh in spec.meshes()]
    clutter = [TrueBody(body.mesh(), sonar_m, spec.voxel_m) for body in spec.clutter]
    objects = result.objects
    shares = np.array([[t.overlap(o.grid) for o in objects] for t in truths]).reshape(
        len(truths), len(objects)
    )
    scores = []
    for n, (body, truth) in enumerate(zip(spec.bodies, truths, strict=True)):
        hull, solid = truth.on(truth.own_volume(spec.voxel_m))
        shadow = shadow_length_m(float(truth.mesh.bounds[1, 2]), spec.radius_m, spec.height_m)
        same: dict[str, Any] = {
            "family": body.family,
            "shadow_cells": round(shadow / spec.cell_m, 2),
            "hull_vs_truth": round(iou(hull, solid), 4),
        }
        mine = [j for j in range(len(objects)) if shares[n, j] >= _LEAST_OVERLAP]
        if not mine:
            scores.append(BodyScore(**same, true_size=truth.sizes()))
            continue
        compared = {j: truth.compared(objects[j].grid) for j in mine}
        best = max(mine, key=lambda j: iou(compared[j][0], compared[j][1]))
        occupied, hull, solid = compared[best]
        measures = objects[best].dimensions
        scores.append(
            BodyScore(
                **same,
                true_size=truth.sizes(measures.heading_rad),
                found=True,
                merged=int((shares[:, best] >= _LEAST_OVERLAP).sum()) > 1,
                iou_hull=round(iou(occupied, hull), 4),
                iou_truth=round(iou(occupied, solid), 4),
                size={name: float(getattr(measures, name)) for name in SIZES},
                intervals={k: v for k, v in measures.intervals.items() if k in SIZES},
            )
        )
    phantoms = [
        (*o.dimensions.position_m, *(getattr(o.dimensions, name) for name in SIZES))
        for j, o in enumerate(objects)
        if not (shares[:, j] > 0.0).any() and not any(c.overlap(o.grid) > 0.0 for c in clutter)
    ]
    return scores, phantoms


def process(spec: SceneSpec, simulated: SimulatedRun) -> tuple[Result | None, list[str], str]:
    """Take a run through the chain as ``csas-shadow run`` does.

    Returns
    -------
    result : Result or None
        None if the run was refused.
    notices : list of str
        What a user is told besides.
    refused : str
        Why it was refused.
    """
    notices: list[str] = []
    try:
        refuse_contradictions(simulated.image, simulated.track, notices.append)
        result = run(simulated.image, simulated.track, spec.parameters(), workers=1)
    except CsasError as error:
        return None, notices, str(error)
    return result, notices, ""


def score_scene(half: str, index: int, shapes: Path | None = None) -> Row:
    """Draw a scene, simulate it, reconstruct it and score it.

    Parameters
    ----------
    half, index
        Which scene.
    shapes : Path, optional
        Folder that takes the voxels of the main body, for pictures.
    """
    began = time.perf_counter()
    spec = draw(half, index)
    simulated = spec.simulate()
    result, notices, refused = process(spec, simulated)
    known = result if result is not None else Result()
    bodies, phantoms = score(spec, simulated.truth.sonar_m, known)
    if shapes is not None and spec.bodies:
        _keep_shapes(shapes / f"{half}_{index}.npz", spec, simulated, known)
    return Row(
        half=half,
        index=index,
        family=spec.family,
        complications=spec.complications,
        contrast_db=round(spec.contrast_db, 2),
        echo_db=round(spec.echo_db, 1),
        grazing_deg=round(spec.grazing_deg, 2),
        radius_m=round(spec.radius_m, 2),
        size_m=round(spec.bodies[0].size_m, 4) if spec.bodies else 0.0,
        cell_m=round(spec.cell_m, 5),
        voxel_m=spec.voxel_m,
        verdict="refused" if refused else known.verdict,
        quality=known.quality.verdict,
        reasons=known.quality.reasons,
        notices=tuple(notices),
        refused=refused,
        phantoms=tuple(tuple(round(float(v), 4) for v in p) for p in phantoms),
        objects=len(known.objects),
        bodies=tuple(bodies),
        seconds=round(time.perf_counter() - began, 2),
    )


def _keep_shapes(path: Path, spec: SceneSpec, simulated: SimulatedRun, result: Result) -> None:
    """Write plan and side views (x, y) of all that was found, of the hulls and of the truth, for pictures."""
    meshes = spec.meshes()
    truths = [TrueBody(mesh, simulated.truth.sonar_m, spec.voxel_m) for mesh in meshes]
    low = np.min([m.bounds[0] for m in meshes], axis=0)
    high = np.max([m.bounds[1] for m in meshes], axis=0)
    for o in result.objects:
        d = o.grid.volume.voxel_size_m
        first = np.asarray(o.grid.volume.origin_m) - d / 2.0
        low, high = np.minimum(low, first), np.maximum(high, first + np.asarray(o.grid.volume.size_m))
    middle, size = (low + high) / 2.0, high - low
    volume = Volume.around(
        (float(middle[0]), float(middle[1])),
        (float(size[0]), float(size[1]), float(high[2] + 2 * spec.voxel_m)),
        spec.voxel_m,
    )
    sets = {"hull": np.zeros(volume.shape, bool), "truth": np.zeros(volume.shape, bool)}
    for truth in truths:
        for name, voxels in zip(("hull", "truth"), truth.on(volume), strict=True):
            sets[name] |= voxels
    found = np.zeros(volume.shape, bool)
    for o in result.objects:
        k, j, i = np.nonzero(o.grid.occupied)
        at = []
        for index, axis, origin, count in zip(
            (k, j, i),
            (o.grid.volume.z_m, o.grid.volume.y_m, o.grid.volume.x_m),
            volume.origin_m[::-1],
            volume.shape,
            strict=True,
        ):
            at.append(
                np.clip(np.rint((axis[index] - origin) / volume.voxel_size_m).astype(int), 0, count - 1)
            )
        found[tuple(at)] = True
    sets["found"] = found
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        **{
            f"{name}_{axis}": voxels.any(axis=k)
            for name, voxels in sets.items()
            for k, axis in enumerate("zyx")
        },
        origin=np.asarray(volume.origin_m),
        voxel=volume.voxel_size_m,
    )


# ---- all scenes


_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def read_rows(path: Path, half: str, code: str | None = None) -> dict[int, Row]:
    """Read the rows of a half; the last one of a scene counts.

    Parameters
    ----------
    path : Path
        The .jsonl file; may be missing, and its last line may be cut short.
    half : str
        Which half.
    code : str, optional
        Leave out the rows that other code made.
    """
    rows: dict[int, Row] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            values = json.loads(line)
        except json.JSONDecodeError:  # the run ended while it wrote this
            continue
        same = values["half"] == half and values["drawing"] == DRAWING
        if same and (code is None or values["code"] == code):
            row = Row.from_json(values)
            rows[row.index] = row
    return rows


def _one_thread() -> None:
    cv2.setNumThreads(1)


def _score_all(half: str, todo: Sequence[int], shapes: Path, workers: int) -> Iterator[Row]:
    # The variables are read when the libraries are loaded: they are for the processes that start now.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread)
    try:
        for future in as_completed([pool.submit(score_scene, half, index, shapes) for index in todo]):
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def run_scenes(
    half: str, indices: Sequence[int], out: Path, *, workers: int = 1, say: Callable[[str], None] = _say
) -> list[Row]:
    """Score scenes and write each down as soon as it is done; those that the same code did are kept.

    Parameters
    ----------
    half : str
        Which half.
    indices : sequence of int
        Which scenes.
    out : Path
        Folder of scenes.jsonl and shapes/.
    workers : int
        Processes, one scene each.
    say : callable
        Takes a line of progress.

    Returns
    -------
    list of Row
        In the order of their numbers.
    """
    out.mkdir(parents=True, exist_ok=True)
    record, code = out / "scenes.jsonl", code_fingerprint()
    rows = {i: row for i, row in read_rows(record, half, code).items() if i in set(indices)}
    todo = [i for i in indices if i not in rows]
    if rows:
        say(f"{len(rows)} of {len(indices)} scenes were done before")
    with record.open("a", encoding="utf-8") as file:
        if record.stat().st_size and not record.read_bytes().endswith(b"\n"):
            file.write("\n")  # a line that was cut short stays alone
        for row in _score_all(half, todo, out / "shapes", workers) if todo else ():
            rows[row.index] = row
            file.write(json.dumps({**asdict(row), "drawing": DRAWING, "code": code}) + "\n")
            file.flush()
            say(f"{len(rows)}/{len(indices)} {row.name} {row.family}: {_outcome(row)}, {row.seconds:.0f} s")
    return [rows[i] for i in sorted(rows)]


def _outcome(row: Row) -> str:
    if row.refused:
        return f"refused: {row.refused[:60]}"
    if not row.bodies:
        return f"{row.objects} objects"
    return ", ".join(f"IoU {b.iou_hull:.2f}" if b.found else "missed" for b in row.bodies)


# ---- the command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--half", choices=HALVES, default=DEVELOPMENT)
    add("--scenes", type=int, default=40, help="how many, from the first on: 40")
    add("--only", type=int, nargs="+", metavar="N", help="these scenes alone")
    add("--workers", type=int, default=2, help="processes, one scene each: 2")
    add("--out", type=Path, required=True, metavar="FOLDER", help="takes scenes.jsonl, page and pictures")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.workers < 1 or options.scenes < 1:
        parser.error("--workers and --scenes expect at least 1")
    indices = options.only or list(range(options.scenes))
    run_scenes(options.half, indices, options.out, workers=options.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
