"""Exact point-sampled rasterisation of unions of triangles, and of crossings of vertical lines.

Compiled, and free of the interpreter lock, because every aspect block of a simulation and every view of a
shadow hull draws a whole mesh.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel


@kernel()
def fill_triangles(triangles: NDArray[np.float64], out: NDArray[np.uint8]) -> None:  # pragma: no cover
    """Set out[v, u] = 1 where the lattice point (u, v) lies inside any triangle.

    Parameters
    ----------
    triangles : ndarray of float64, shape (n, 3, 2)
        Corners (u, v) in lattice units; either winding.
    out : ndarray of uint8, shape (rows, cols)
        Drawn into; parts of triangles beyond it are cut off.
    """
    rows, cols = out.shape
    for t in range(triangles.shape[0]):
        v_low = min(triangles[t, 0, 1], triangles[t, 1, 1], triangles[t, 2, 1])
        v_high = max(triangles[t, 0, 1], triangles[t, 1, 1], triangles[t, 2, 1])
        first = max(0, math.ceil(max(v_low, -1.0)))
        last = min(rows - 1, math.floor(min(v_high, rows * 1.0)))
        for v in range(first, last + 1):
            left, right = 1e30, -1e30
            for i in range(3):
                j = i + 1 if i < 2 else 0
                u0, v0 = triangles[t, i, 0], triangles[t, i, 1]
                u1, v1 = triangles[t, j, 0], triangles[t, j, 1]
                if (v0 <= v and v <= v1) or (v1 <= v and v <= v0):
                    if v0 == v1:
                        left, right = min(left, u0, u1), max(right, u0, u1)
                    else:
                        u = u0 + (v - v0) / (v1 - v0) * (u1 - u0)
                        left, right = min(left, u), max(right, u)
            if right < 0.0 or left > cols - 1:
                continue
            for u in range(max(0, math.ceil(left)), min(cols - 1, math.floor(right)) + 1):
                out[v, u] = 1


@kernel()
def add_windings(triangles: NDArray[np.float64], out: NDArray[np.int16]) -> None:  # pragma: no cover
    """Add ±1 at the voxel just under each crossing of a vertical line of voxel centres with a triangle.

    Summing `out` from the top down gives the winding number of each voxel centre: 0 outside, 1 or more inside
    one or several closed bodies whose normals point outwards.

    Parameters
    ----------
    triangles : ndarray of float64, shape (n, 3, 3)
        Corners (x, y, z) in voxel units, voxel centres at integers.
    out : ndarray of int16, shape (nz, ny, nx)
        Added to.
    """
    nz, ny, nx = out.shape
    for t in range(triangles.shape[0]):
        ax, ay, az = triangles[t, 0]
        bx, by, bz = triangles[t, 1]
        cx, cy, cz = triangles[t, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        sign = 1 if area > 0 else -1
        x_first, x_last = max(0, math.ceil(min(ax, bx, cx))), min(nx - 1, math.floor(max(ax, bx, cx)))
        y_first, y_last = max(0, math.ceil(min(ay, by, cy))), min(ny - 1, math.floor(max(ay, by, cy)))
        for y in range(y_first, y_last + 1):
            for x in range(x_first, x_last + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                z = wa * az + wb * bz + wc * cz
                k = min(nz - 1, math.floor(z))
                if k >= 0:
                    out[k, y, x] += sign


@kernel()
def keep_shadowed(
    alive: NDArray[np.bool_],
    axes: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    sonar: NDArray[np.float64],
    silhouette: NDArray[np.uint8],
    origin: tuple[float, float],
    spacing: float,
) -> None:  # pragma: no cover
    """Remove the voxels whose shadow point has no lattice point of a silhouette round it.

    Parameters
    ----------
    alive : ndarray of bool, shape (nz, ny, nx)
        Voxels still standing; cleared in place.
    axes : (x, y, z)
        Voxel centres along each axis, metres.
    sonar : ndarray, shape (3,)
        Sonar position.
    silhouette : ndarray of uint8, shape (rows, cols)
        1 in shadow, on the seabed.
    origin : (float, float)
        Scene x, y of its lattice point (0, 0); rows grow along +y here.
    spacing : float
        Its spacing, metres.
    """
    nz, ny, nx = alive.shape
    rows, cols = silhouette.shape
    xs, ys, zs = axes
    for k in range(nz):
        scale = sonar[2] / (sonar[2] - zs[k])
        for j in range(ny):
            v = (sonar[1] + (ys[j] - sonar[1]) * scale - origin[1]) / spacing
            row = math.floor(v)
            for i in range(nx):
                if not alive[k, j, i]:
                    continue
                u = (sonar[0] + (xs[i] - sonar[0]) * scale - origin[0]) / spacing
                col = math.floor(u)
                on_lattice = 0 <= row < rows - 1 and 0 <= col < cols - 1
                alive[k, j, i] = on_lattice and (
                    silhouette[row, col] > 0
                    or silhouette[row, col + 1] > 0
                    or silhouette[row + 1, col] > 0
                    or silhouette[row + 1, col + 1] > 0
                )
