"""Where a carved body can echo: the pixels of a view that its own echo may cover.

A scatterer at (x, y, z) is imaged at (x, y) + z tan ψ û(θ), towards the sonar. The target's echo therefore
lies over seabed that it hides or that lies before it, and a lit pixel there does not say that the seabed
is free. Which pixels these are follows from the shape: what can be seen of it from the sonar, laid over. Lit
pixels elsewhere are seabed, also those under an overhang, between the echo and the shadow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..geometry import ViewInfo, unit_to_sonar
from ..kernels import kernel
from .volume import Volume

BoolArray = NDArray[np.bool_]

#: A body's echo covers so many resolution cells beyond the voxel that it comes from, down-range and across,
#: by the width of a cell alone. Mean IoU of twenty bodies 0.791; half 0.792, double 0.780 (two spheres lose
#: 0.07 and 0.12): docs/method.md, "The second look".
MAIN_LOBE_CELLS = (1.5, 1.5)
#: And so many may show it: strong echoes have sidelobes, and sound that bounced twice arrives late. With
#: fewer, the measured vehicle of docs/examples.md is hollowed out from below.
SIDELOBE_CELLS = (7.0, 5.0)


def layover_per_metre(info: ViewInfo) -> NDArray[np.float64]:
    """Return tan ψ û(θ): how far, for each metre of height, an echo lies towards the sonar."""
    return np.asarray(math.tan(info.camera.grazing_rad) * unit_to_sonar(info.aspect_rad), dtype=np.float64)


def opaque_part(occupied: BoolArray, grazing_rad: float, slack_voxels: float = 1.0) -> BoolArray:
    """Return the voxels of a carved body that block the view, whatever the shape of its true top.

    Shadows do not tell a flat top from one that rises towards its middle at less than the grazing angle:
    carving leaves that cap standing. A voxel under the top by less than the cap may be free in truth.

    Parameters
    ----------
    occupied : ndarray of bool, shape (nz, ny, nx)
        Carved body.
    grazing_rad : float
        ψ.
    slack_voxels : float
        Added to the cap's thickness, which is tan ψ times the distance from the layer's edge.
    """
    opaque = np.zeros_like(occupied)
    covered = np.zeros(occupied.shape[1:], np.float32)
    tan_grazing = math.tan(grazing_rad)
    for k in range(occupied.shape[0] - 1, -1, -1):
        covered = np.where(occupied[k], covered + 1, 0).astype(np.float32)
        if occupied[k].any():
            inside = scipy.ndimage.distance_transform_edt(occupied[k])
            opaque[k] = occupied[k] & (covered - 1 > tan_grazing * inside + slack_voxels)
    return opaque


@kernel()
def _unhidden(
    opaque: BoolArray, i: float, j: float, k: float, di: float, dj: float, dk: float
) -> bool:  # pragma: no cover
    """Walk from a point (voxel indices) towards the sonar; False if an opaque voxel is in the way."""
    nz, ny, nx = opaque.shape
    while True:
        a, b, c = math.floor(i + 0.5), math.floor(j + 0.5), math.floor(k + 0.5)
        if a < 0 or b < 0 or a >= nx or b >= ny or c >= nz:
            return True
        if c >= 0 and opaque[c, b, a]:
            return False
        i += di
        j += dj
        k += dk


@kernel()
def _seen(
    opaque: BoolArray, i: int, j: int, k: int, di: float, dj: float, dk: float, lift: float
) -> bool:  # pragma: no cover
    """Say whether the sonar, that way, sees a voxel or one of its free faces, from `lift` voxels higher."""
    nz, ny, nx = opaque.shape
    if not opaque[k, j, i]:
        return _unhidden(opaque, i, j, k + lift, di, dj, dk)
    face = 0.52  # just outside a voxel
    if (k + 1 >= nz or not opaque[k + 1, j, i]) and _unhidden(opaque, i, j, k + face + lift, di, dj, dk):
        return True
    a = 1 if di > 0 else -1
    free = i + a < 0 or i + a >= nx or not opaque[k, j, i + a]
    if free and _unhidden(opaque, i + face * a, j, k + lift, di, dj, dk):
        return True
    a = 1 if dj > 0 else -1
    free = j + a < 0 or j + a >= ny or not opaque[k, j + a, i]
    return free and _unhidden(opaque, i, j + face * a, k + lift, di, dj, dk)


@kernel()
def count_looks(
    voxels: NDArray[np.int32],
    opaque: BoolArray,
    fuller: BoolArray,
    lift: float,
    origin: NDArray[np.float64],
    step: float,
    sonar: NDArray[np.float64],
    layover: NDArray[np.float64],
    affine: NDArray[np.float64],
    dark: BoolArray,
    known: BoolArray,
    seen: NDArray[np.int32],
    dark_seen: NDArray[np.int32],
) -> None:  # pragma: no cover
    """Count a view's look at each voxel that it sees, and whether it is dark where the voxel is imaged.

    Parameters
    ----------
    voxels : ndarray of int32, shape (n, 3)
        (k, j, i) of opaque voxels.
    opaque : ndarray of bool, shape (nz, ny, nx)
        What hides.
    fuller : ndarray of bool, shape (nz, ny, nx) or (0, 0, 0)
        If not empty: count only looks at what this body, of which `opaque` is a part, would hide.
    lift : float
        A ray passes over what rises no more than this above it (voxels).
    origin, step : ndarray, shape (3,), and float
        (x, y, z) of voxel [0, 0, 0] and edge of a voxel, m.
    sonar : ndarray, shape (3,)
        Sonar position, m.
    layover : ndarray, shape (2,)
        tan ψ û(θ).
    affine : ndarray, shape (2, 3)
        Ground metres to (column, row) of `dark` and `known`.
    dark, known : ndarray of bool, shape (rows, cols)
        The view.
    seen, dark_seen : ndarray of int32, shape (n,)
        Counts, added to.
    """
    rows, cols = dark.shape
    for m in range(voxels.shape[0]):
        k, j, i = voxels[m, 0], voxels[m, 1], voxels[m, 2]
        x, y, z = origin[0] + i * step, origin[1] + j * step, origin[2] + k * step
        px, py = x + z * layover[0], y + z * layover[1]
        u = math.floor(affine[0, 0] * px + affine[0, 1] * py + affine[0, 2] + 0.5)
        v = math.floor(affine[1, 0] * px + affine[1, 1] * py + affine[1, 2] + 0.5)
        if u < 0 or v < 0 or u >= cols or v >= rows or not known[v, u]:
            continue
        di, dj, dk = sonar[0] - x, sonar[1] - y, sonar[2] - z
        length = 2.0 * max(abs(di), abs(dj), abs(dk))  # half a voxel a step
        di, dj, dk = di / length, dj / length, dk / length
        if not _seen(opaque, i, j, k, di, dj, dk, lift):
            continue
        if fuller.size and _seen(fuller, i, j, k, di, dj, dk, lift):
            continue
        seen[m] += 1
        dark_seen[m] += dark[v, u]


@kernel()
def _mark_echoes(
    occupied: BoolArray,
    opaque: BoolArray,
    origin: NDArray[np.float64],
    step: float,
    sonar: NDArray[np.float64],
    layover: NDArray[np.float64],
    affine: NDArray[np.float64],
    out: BoolArray,
) -> None:  # pragma: no cover
    """Mark the pixels that voxels in view are imaged on."""
    nz, ny, nx = occupied.shape
    rows, cols = out.shape
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                if not occupied[k, j, i]:
                    continue
                x, y, z = origin[0] + i * step, origin[1] + j * step, origin[2] + k * step
                px, py = x + z * layover[0], y + z * layover[1]
                u = math.floor(affine[0, 0] * px + affine[0, 1] * py + affine[0, 2] + 0.5)
                v = math.floor(affine[1, 0] * px + affine[1, 1] * py + affine[1, 2] + 0.5)
                if u < 0 or v < 0 or u >= cols or v >= rows or out[v, u]:
                    continue
                di, dj, dk = sonar[0] - x, sonar[1] - y, sonar[2] - z
                length = 2.0 * max(abs(di), abs(dj), abs(dk))  # half a voxel a step
                di, dj, dk = di / length, dj / length, dk / length
                if _seen(opaque, i, j, k, di, dj, dk, 0.0):
                    out[v, u] = True


def echo_zones(
    info: ViewInfo,
    volume: Volume,
    occupied: BoolArray,
    opaque: BoolArray,
    reaches_cells: Sequence[tuple[float, float]] = (SIDELOBE_CELLS,),
) -> list[BoolArray]:
    """Mark the pixels of a view that the echo of a carved body may cover.

    Parameters
    ----------
    info : ViewInfo
        The view.
    volume : Volume
        Lattice of the body.
    occupied : ndarray of bool, shape (nz, ny, nx)
        Where there may be matter.
    opaque : ndarray of bool, shape (nz, ny, nx)
        What surely hides what is behind it (`opaque_part`).
    reaches_cells : sequence of (float, float)
        How far an echo shows beyond its voxel, resolution cells down-range and across.

    Returns
    -------
    list of ndarray of bool, shape (rows, cols)
        For each reach.

    Notes
    -----
    Layover: (x, y) + z tan ψ û(θ).
    """
    camera = info.camera
    half = volume.voxel_size_m / 2.0
    reaches = [
        tuple(
            math.ceil((half + cells * cell) / spacing)
            for cells, cell, spacing in zip(reach, info.resolution_m, camera.spacing_m, strict=True)
        )
        for reach in reaches_cells
    ]
    # Echoes beside the view reach into it.
    rows, cols = (max(along) for along in zip(*reaches, strict=True))
    out = np.zeros((camera.rows + 2 * rows, camera.cols + 2 * cols), np.bool_)
    affine = np.array(camera.ground_to_pixel[:2])
    affine[:, 2] += (cols, rows)
    _mark_echoes(
        np.ascontiguousarray(occupied),  # a part of a grid would need a kernel of its own
        opaque,
        np.asarray(volume.origin_m, dtype=np.float64),
        volume.voxel_size_m,
        np.asarray(camera.sonar_m, dtype=np.float64),
        layover_per_metre(info),
        affine,
        out,
    )
    zones = []
    for down, across in reaches:
        box = np.ones((2 * down + 1, 2 * across + 1), np.uint8)
        zone = cv2.dilate(out.view(np.uint8), box).view(np.bool_)
        zones.append(np.ascontiguousarray(zone[rows : rows + camera.rows, cols : cols + camera.cols]))
    return zones
