"""The target, the volume carved round it, and the carved grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..equality import equal_where_nan
from ..errors import (
    GeometryError,
    InputTypeError,
    check_numbers,
    check_range,
    check_type,
    check_whole,
    quoted,
)
from ..methods import method_named

if TYPE_CHECKING:
    from .seabed import SeabedSlope

#: Margin round a body in the carved volume, as a share of its size.
MARGIN_SHARE = 0.25


@equal_where_nan
@dataclass(frozen=True)
class Target:
    """A body that the search found.

    Parameters
    ----------
    position_m : (float, float)
        Middle (x, y) of the volume to carve.
    size_m : (float, float, float)
        Size (x, y, z) of the volume to carve, margin included.
    evidence : float
        Sum of height over the body's voxels, m⁴: large for a large, high body.
    stands : bool
        Whether the body rests on the seabed (`stands_on_seabed`).
    """

    position_m: tuple[float, float]
    size_m: tuple[float, float, float]
    evidence: float = math.nan
    stands: bool = True

    @property
    def reach_m(self) -> float:
        """Distance from the middle within which the target's own shadows begin (margin excluded)."""
        return 0.5 * math.hypot(self.size_m[0], self.size_m[1]) / (1.0 + 2.0 * MARGIN_SHARE)

    def covers(self, position_m: tuple[float, float]) -> bool:
        """Say whether a place lies in the volume to carve."""
        return all(
            abs(p - t) <= s / 2 for p, t, s in zip(position_m, self.position_m, self.size_m, strict=False)
        )

    def volume(self, voxel_size_m: float) -> Volume:
        """Return the lattice to carve."""
        return Volume.around(self.position_m, self.size_m, voxel_size_m)


@dataclass(frozen=True)
class Volume:
    """A lattice of cubic voxels in the scene frame.

    Parameters
    ----------
    origin_m : (float, float, float)
        Scene (x, y, z) of the centre of voxel [0, 0, 0].
    voxel_size_m : float
        Edge of a voxel.
    shape : (int, int, int)
        Voxels along (z, y, x).
    """

    origin_m: tuple[float, float, float]
    voxel_size_m: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        check_range("voxel size", self.voxel_size_m, 0, 1e4, "m", open_low=True)
        check_numbers("origin of the volume", self.origin_m, 3, "m")
        if not isinstance(self.shape, tuple) or len(self.shape) != 3:
            raise InputTypeError(f"shape of the volume is {quoted(self.shape)}; expected three whole numbers")
        for axis, n in zip("zyx", self.shape, strict=True):
            check_whole(f"number of voxels along {axis}", n, 1, 1 << 14)

    @classmethod
    def around(
        cls, position_m: tuple[float, float], size_m: tuple[float, float, float], voxel_size_m: float
    ) -> Volume:
        """Make the volume that stands on the seabed round a ground position.

        Parameters
        ----------
        position_m : (float, float)
            Middle (x, y).
        size_m : (float, float, float)
            Extent along (x, y, z), rounded up to whole voxels.
        voxel_size_m : float
            Edge of a voxel; the lowest layer's centres are at half of it.
        """
        d = voxel_size_m
        nx, ny, nz = (max(1, int(np.ceil(s / d - 1e-9))) for s in size_m)
        x, y = (c - (n - 1) / 2.0 * d for c, n in zip(position_m, (nx, ny), strict=True))
        return cls((x, y, d / 2.0), d, (nz, ny, nx))

    @property
    def x_m(self) -> NDArray[np.float64]:
        """Centres along x, shape (nx,)."""
        return self.origin_m[0] + np.arange(self.shape[2], dtype=np.float64) * self.voxel_size_m

    @property
    def y_m(self) -> NDArray[np.float64]:
        """Centres along y, shape (ny,)."""
        return self.origin_m[1] + np.arange(self.shape[1], dtype=np.float64) * self.voxel_size_m

    @property
    def z_m(self) -> NDArray[np.float64]:
        """Centres along z, shape (nz,)."""
        return self.origin_m[2] + np.arange(self.shape[0], dtype=np.float64) * self.voxel_size_m

    @property
    def centre_m(self) -> tuple[float, float, float]:
        """Middle (x, y, z) of the volume."""
        nz, ny, nx = self.shape
        half = self.voxel_size_m / 2.0
        x, y, z = self.origin_m
        return x + (nx - 1) * half, y + (ny - 1) * half, z + (nz - 1) * half

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Extent along (x, y, z)."""
        nz, ny, nx = self.shape
        return nx * self.voxel_size_m, ny * self.voxel_size_m, nz * self.voxel_size_m


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """The result of carving.

    Parameters
    ----------
    volume : Volume
        The lattice.
    likelihood : ndarray of float32, shape (nz, ny, nx)
        Mean l_out (soft), or the fraction of its views that contradict the voxel (consensus, hard); NaN where
        unknown.
    views : ndarray of uint16, shape (nz, ny, nx)
        How many views know something of each voxel.
    threshold : float
        Object where likelihood < threshold. NaN if there is no object.
    occupied : ndarray of bool, shape (nz, ny, nx)
        The object's voxels.
    method : str
        How the voxels were carved: a name of `core.methods.METHODS`.
    seabed : SeabedSlope, optional
        How the seabed seems to slope; where that is believed, the grid was carved over it.
    """

    volume: Volume
    likelihood: NDArray[np.float32]
    views: NDArray[np.uint16]
    threshold: float
    occupied: NDArray[np.bool_]
    method: str = "consensus"
    seabed: SeabedSlope | None = None

    def __post_init__(self) -> None:
        check_type("volume of the grid", self.volume, Volume, "a Volume")
        method_named(self.method)
        for name, kind in (("likelihood", np.floating), ("views", np.number), ("occupied", np.bool_)):
            values = getattr(self, name)
            check_type(f"{name} of the grid", values, np.ndarray, "an array of numpy")
            if not np.issubdtype(values.dtype, kind):
                wanted = kind.__name__.rstrip("_")
                raise InputTypeError(f"{name} of the grid is {values.dtype}; expected {wanted}")
            if values.shape != self.volume.shape:
                raise GeometryError(
                    f"{name} of the grid has shape {values.shape}; its volume says {self.volume.shape}"
                    " (z, y, x)"
                )

    def __repr__(self) -> str:
        nz, ny, nx = self.volume.shape
        x, y, z = self.volume.size_m
        return (
            f"VoxelGrid: {nx} × {ny} × {nz} voxels (x, y, z) of {self.volume.voxel_size_m:g} m"
            f" = {x:.2f} × {y:.2f} × {z:.2f} m\n"
            f"  {self.method}, threshold {self.threshold:.3g},"
            f" {int(np.count_nonzero(self.occupied))} occupied,"
            f" {int(np.count_nonzero(~np.isfinite(self.likelihood)))} unknown"
        )
