"""What a scene of the population came to, scored against its truth."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from accuracy import lattice_over
from numpy.typing import NDArray
from population_scenes import SceneSpec, draw, shadow_length_m

from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.pipeline import Result, run
from csas_shadow_ros.core.shape.mesh import measure
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.from_bag import refuse_contradictions
from csas_shadow_ros.simulation import SimulatedRun, iou, shadow_hull, voxelise_truth

SIZES = ("length_m", "width_m", "height_m")
#: Aspects whose silhouettes make the shadow hull.
HULL_VIEWS = 120
SIZE_TOLERANCE = 0.05
#: What the bounds on found objects are asked of.
LEAST_CONTRAST_DB, LEAST_SHADOW_CELLS = 6.0, 3.0


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
    code : str
        Digest of the code that it was made by.
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
    code: str = ""

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
    room = np.array([4.0 * spec.voxel_m, 4.0 * spec.voxel_m, 0.0])
    low, high = low - room, high + room
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
