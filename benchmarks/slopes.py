"""Bodies that slope, single and without faults: what their results are worth, family by family.

The population draws many faults beside one another. Here a shape is all there is, seen at 12° to 34° on a
plain seabed: what is wrong is the shape's own. Cones and what is like them lose their tips, flanks below the
grazing angle cast no shadow, and a low foot is as bright as the seabed, or brighter::

    python benchmarks/slopes.py --scenes 96 --workers 2

The table counts extents within 5 % or a voxel, extents in their 95 % intervals, and scenes in which one lies
outside of its interval (and of 5 % and a voxel) though the result is called good.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from population import in_processes
from population_scenes import FAMILIES, Body, Family, Rng, SceneSpec
from population_scores import SIZES, process, score

from csas_shadow_ros.simulation import Faults, Seabed
from csas_shadow_ros.simulation.bodies import Parts, brick, convex

_SEED = 0x510


def _ring(height: float, radius: float, squeezed: float = 1.0) -> NDArray[np.float64]:
    turn = np.arange(32) * (2.0 * math.pi / 32)
    return np.column_stack(
        [radius * np.cos(turn), squeezed * radius * np.sin(turn), np.full(32, float(height))]
    )


def _slope(rng: Rng, low_deg: float = 22.0, high_deg: float = 60.0) -> float:
    return math.tan(math.radians(rng.uniform(low_deg, high_deg)))


def _point(rng: Rng) -> Parts:
    return [convex(np.vstack([_ring(0.0, 0.5), [[0.0, 0.0, 0.5 * _slope(rng)]]]))]


def _blunt(rng: Rng) -> Parts:
    top = float(rng.uniform(0.15, 0.35))
    return [convex(np.vstack([_ring(0.0, 0.5), _ring((0.5 - top) * _slope(rng), top)]))]


def _cap(rng: Rng) -> Parts:
    high = float(rng.uniform(0.12, 0.45))
    radius = (0.25 + high * high) / (2.0 * high)
    heights = np.linspace(0.0, high, 7)
    rings = [_ring(z, math.sqrt(max(0.0, radius**2 - (radius - high + z) ** 2))) for z in heights[:-1]]
    return [convex(np.vstack([*rings, [[0.0, 0.0, high]]]))]


def _oval(rng: Rng) -> Parts:
    squeezed = float(rng.uniform(0.5, 0.8))
    return [convex(np.vstack([_ring(0.0, 0.5, squeezed), _ring(0.4 * _slope(rng), 0.1, squeezed)]))]


def _plinth(rng: Rng) -> Parts:
    top = float(rng.uniform(0.2, 0.3))
    high = (0.5 - top) * _slope(rng, 12.0, 30.0)
    drum = [_ring(high, 0.9 * top), _ring(high + float(rng.uniform(0.15, 0.35)), 0.9 * top)]
    return [convex(np.vstack([_ring(0.0, 0.5), _ring(high, top)])), convex(np.vstack(drum))]


def _ridge(rng: Rng) -> Parts:
    half = float(rng.uniform(0.2, 0.45))
    feet = [(x, y, 0.0) for x in (-0.5, 0.5) for y in (-half, half)]
    return [convex([*feet, (-0.5, 0.0, half * _slope(rng)), (0.5, 0.0, half * _slope(rng))])]


def _block(rng: Rng) -> Parts:
    return [brick((1.0, float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.2, 0.6))))]


def _disc(rng: Rng) -> Parts:
    high = float(rng.uniform(0.2, 0.9))
    return [convex(np.vstack([_ring(0.0, 0.5), _ring(high, 0.5)]))]


_SIZE_M = (0.4, 1.6)
_MAKERS: dict[str, tuple[Callable[[Rng], Parts], str]] = {
    "point": (_point, "cone of 22° to 60°"),
    "blunt": (_blunt, "the same, cut off at 0.3 to 0.7 of its width"),
    "cap": (_cap, "part of a sphere"),
    "oval": (_oval, "cone over an ellipse, cut off at a fifth"),
    "plinth": (_plinth, "drum on a foot of 12° to 30°"),
    "ridge": (_ridge, "roof"),
    "block": (_block, "box, which does not slope"),
    "disc": (_disc, "standing cylinder, which does not slope"),
}
FAMILIES["slopes"] = {
    f"slope_{name}": Family(make, _SIZE_M, text) for name, (make, text) in _MAKERS.items()
}


@dataclass(frozen=True)
class Told:
    """What one scene's result says.

    Parameters
    ----------
    family : str
        Of its body.
    quality : str
        Verdict; "not found" where there is no object.
    within, holds : tuple of bool
        Of each extent that was told: whether it is within 5 % or a voxel; whether its interval holds it.
    off_cells : tuple of float
        Its error, cross-range cells.
    """

    family: str
    quality: str
    within: tuple[bool, ...] = ()
    holds: tuple[bool, ...] = ()
    off_cells: tuple[float, ...] = ()

    @property
    def wrong_unflagged(self) -> bool:
        """Whether an extent is outside of all that it is allowed, and nothing says so."""
        return self.quality == "good" and any(
            not near and not held for near, held in zip(self.within, self.holds, strict=True)
        )


def draw_slope(index: int) -> SceneSpec:
    """Draw a scene: a body in the middle, 60 views, a plain seabed.

    Parameters
    ----------
    index : int
        Number of the scene; families take turns.
    """
    rng = np.random.default_rng([index, _SEED])
    names = list(FAMILIES["slopes"])
    size = float(np.exp(rng.uniform(*np.log(_SIZE_M))))
    place = tuple(float(x) for x in rng.uniform(-0.2, 0.2, 2) * size)
    seed, heading = int(rng.integers(1 << 31)), float(rng.uniform(0.0, 360.0))
    body = Body(names[index % len(names)], seed, size, heading, place_m=(place[0], place[1]))
    grazing, spacing = float(rng.uniform(12.0, 34.0)), float(rng.choice([0.004, 0.006, 0.009]))
    side = size * (1.6 + 1.6 / math.tan(math.radians(grazing)))
    contrast = float(rng.uniform(8.0, 18.0))
    return SceneSpec(
        half="slopes",
        index=index,
        complications=(),
        bodies=(body,),
        clutter=(),
        radius_m=float(rng.uniform(25.0, 110.0)),
        grazing_deg=grazing,
        pixels=int(min(1408, max(448, 64 * math.ceil(side / spacing / 64)))),
        spacing_m=spacing,
        bandwidth=float(rng.choice([0.25, 1.0 / 3.0, 0.5])),
        contrast_db=contrast,
        echo_db=float(rng.uniform(0.0, 18.0)),
        clockwise=bool(rng.integers(2)),
        start_aspect_deg=float(rng.uniform(0.0, 360.0)),
        faults=Faults(contrast_db=contrast),
        bed=Seabed(),
        voxel_m=max(0.01, round(size / 50.0, 3)),
        oversampling=1.5,
        seed=int(rng.integers(1 << 31)),
    )


def told_of(index: int) -> Told:
    """Draw a scene, take it through the chain, and compare."""
    spec = draw_slope(index)
    simulated = spec.simulate()
    result, _, _ = process(spec, simulated)
    name = spec.family.removeprefix("slope_")
    if result is None or not result.objects:
        return Told(name, "not found")
    body = score(spec, simulated.truth.sonar_m, result)[0][0]
    if not body.found:
        return Told(name, "not found")
    extents = [extent for extent in SIZES if extent in body.intervals]
    return Told(
        name,
        result.quality.verdict,
        tuple(bool(body.within(extent, spec.voxel_m)) for extent in extents),
        tuple(bool(body.holds(extent)) for extent in extents),
        tuple((body.size[extent] - body.true_size[extent]) / spec.cell_m for extent in extents),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=48, help="how many, from the first on: %(default)s")
    parser.add_argument("--workers", type=int, default=2, help="processes, one scene each: %(default)s")
    given = parser.parse_args()
    rows: dict[str, list[Told]] = defaultdict(list)
    for told in in_processes(told_of, [(index,) for index in range(given.scenes)], given.workers):
        rows[told.family].append(told)
    print("family   scenes  found  good  within  holds  wrong and good")
    everything = [told for of in rows.values() for told in of]
    for family, of in [*((name, rows[name]) for name in _MAKERS if name in rows), ("all", everything)]:
        found = [told for told in of if told.quality != "not found"]
        within = [near for told in found for near in told.within]
        holds = [held for told in found for held in told.holds]
        print(
            f"{family:8} {len(of):6} {len(found):6} {sum(told.quality == 'good' for told in found):5}"
            f" {100.0 * np.mean(within):6.0f}% {100.0 * np.mean(holds):5.0f}%"
            f" {sum(told.wrong_unflagged for told in found):15}"
        )


if __name__ == "__main__":
    main()
