"""What hides a point from the sonar: Embree where it is installed, else every triangle is tried.

Embree has no wheel for Linux on ARM64. Of what else could be had, trimesh's own ray casting took fourteen
times as long for a box, and the R-tree that it needs crashed at the end of the process. Trying all takes no
longer than Embree for a box, and ten times as long for a rock of 5120 faces. The two differ where a ray
passes an edge within Embree's float32 rounding.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
#: Origins and unit directions of rays, shape (n, 3) each, to whether something is in their way, shape (n,).
Tracer = Callable[[FloatArray, FloatArray], BoolArray]


def make_tracer(triangles_m: FloatArray) -> Tracer:
    """Make what tells whether rays meet a scene.

    Parameters
    ----------
    triangles_m : ndarray, shape (n, 3, 3)
        The scene.

    Returns
    -------
    callable
        Takes origins and unit directions, shape (m, 3) each; gives True for each ray that meets a triangle.

    Examples
    --------
    >>> import numpy as np
    >>> occluded = make_tracer(np.array([[[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]]))
    >>> occluded(np.array([[0.2, 0.2, 0.0], [0.9, 0.9, 0.0]]), np.array([[0.0, 0, 1], [0, 0, 1]]))
    array([ True, False])
    """
    try:
        return embree_tracer(triangles_m)
    except ImportError:
        return plain_tracer(triangles_m)


def embree_tracer(triangles_m: FloatArray) -> Tracer:
    """Make a tracer of Embree's; ImportError where embreex is not installed."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, triangles_m.astype(np.float32))

    def occluded(origins: FloatArray, directions: FloatArray) -> BoolArray:
        hit = scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="OCCLUDED",
        )
        return np.asarray(hit) >= 0

    return occluded


@kernel()
def _meets_any(
    origins: FloatArray,
    directions: FloatArray,
    corner: FloatArray,
    e1: FloatArray,
    e2: FloatArray,
    out: BoolArray,
) -> None:
    """Tell which rays meet a triangle: o + t d = a + u e₁ + v e₂ (Möller and Trumbore 1997)."""
    for i in range(len(origins)):
        ox, oy, oz = origins[i]
        dx, dy, dz = directions[i]
        for j in range(len(corner)):
            ax, ay, az = e1[j]
            bx, by, bz = e2[j]
            px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
            volume = ax * px + ay * py + az * pz
            if volume == 0.0:  # the ray lies in the triangle's plane
                continue
            scale = 1.0 / volume
            tx, ty, tz = ox - corner[j, 0], oy - corner[j, 1], oz - corner[j, 2]
            u = (tx * px + ty * py + tz * pz) * scale
            if u < 0.0 or u > 1.0:
                continue
            qx, qy, qz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
            v = (dx * qx + dy * qy + dz * qz) * scale
            if v < 0.0 or u + v > 1.0:
                continue
            if (bx * qx + by * qy + bz * qz) * scale > 0.0:
                out[i] = True
                break


def plain_tracer(triangles_m: FloatArray) -> Tracer:
    """Make a tracer that tries every triangle."""
    corner = np.ascontiguousarray(triangles_m[:, 0], dtype=np.float64)
    e1, e2 = (np.ascontiguousarray(triangles_m[:, i] - triangles_m[:, 0], dtype=np.float64) for i in (1, 2))

    def occluded(origins: FloatArray, directions: FloatArray) -> BoolArray:
        out = np.zeros(len(origins), bool)
        origins, directions = (np.ascontiguousarray(a, dtype=np.float64) for a in (origins, directions))
        _meets_any(origins, directions, corner, e1, e2, out)
        return out

    return occluded
