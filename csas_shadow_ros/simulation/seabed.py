"""A seabed that is not flat and of one level: patches, steps and texture, ripples, pits and mounds.

Levels. They scale the amplitude of the seabed's one reflectivity, the same for every aspect.

Relief z(x, y). A point g of it is imaged at p = g + z tan ψ û, as echoes are; it lies in the target's
shadow where the flat seabed's point g - z cot ψ û on the same ray does. So the picture of the shadow on the
flat seabed is read at p - z (tan ψ + cot ψ) û. Lambert's law, over that of the flat seabed, makes the slopes
that face the sonar bright (amplitude cos i / (sin ψ sqrt(n_z))), and what the relief itself hides is dark.
Heights are far smaller than what they are spread over: z at p serves for z at g.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import ParameterError, check_range
from ..core.geometry import GroundGrid
from .occlusion import embree_tracer

FloatArray = NDArray[np.float64]

#: Points across the image on which the relief's own brightness and shadow are told.
_RELIEF_POINTS = 224
_TEXTURE_WAVES = 48
_RAY_LIFT_M = 1e-3


@dataclass(frozen=True)
class Patch:
    """An ellipse of other sediment.

    Parameters
    ----------
    centre_m : (float, float)
        Middle (x, y).
    radii_m : (float, float)
        Semi-axes.
    turn_deg : float
        Direction of the first, counter-clockwise.
    level_db : float
        Its level over the rest.
    edge : float
        Width of its edge as a share of its radii; 0: sharp.
    """

    centre_m: tuple[float, float]
    radii_m: tuple[float, float]
    turn_deg: float
    level_db: float
    edge: float = 0.0

    def __post_init__(self) -> None:
        for radius in self.radii_m:
            check_range("patch radius", radius, 0.0, 1e5, "m", open_low=True)
        check_range("patch level_db", self.level_db, -60.0, 60.0, "dB")
        check_range("patch edge", self.edge, 0.0, 1.0)

    def db(self, x: Any, y: Any) -> Any:
        """Return the level at points."""
        turn = math.radians(self.turn_deg)
        dx, dy = x - self.centre_m[0], y - self.centre_m[1]
        u = (dx * math.cos(turn) + dy * math.sin(turn)) / self.radii_m[0]
        v = (dy * math.cos(turn) - dx * math.sin(turn)) / self.radii_m[1]
        return self.level_db * np.clip((1.0 - np.hypot(u, v)) / max(self.edge, 1e-6) + 0.5, 0.0, 1.0)


@dataclass(frozen=True)
class Bump:
    """A mound, or a pit where its height is negative: h (1 + cos(π r / radius)) / 2.

    Parameters
    ----------
    centre_m : (float, float)
        Middle (x, y).
    radius_m : float
        Where it ends.
    height_m : float
        Of its middle.
    """

    centre_m: tuple[float, float]
    radius_m: float
    height_m: float

    def __post_init__(self) -> None:
        check_range("bump radius", self.radius_m, 0.0, 1e5, "m", open_low=True)

    def height(self, x: Any, y: Any) -> Any:
        """Return the height at points."""
        r = np.hypot(x - self.centre_m[0], y - self.centre_m[1]) / self.radius_m
        return np.where(r < 1.0, 0.5 * self.height_m * (1.0 + np.cos(math.pi * np.minimum(r, 1.0))), 0.0)


@dataclass(frozen=True)
class Seabed:
    """Levels and relief of a seabed; flat and of one level by default.

    Parameters
    ----------
    seed : int
        Of the texture.
    patches : tuple of Patch
        Other sediment; levels add up.
    step_db, step_deg, step_m : float
        Beyond a straight line, `step_m` from the origin in the direction `step_deg`, the level is so much
        higher.
    texture_db, texture_m : float
        Rms and shortest wavelength of a smooth random level.
    ripple_m, ripple_length_m, ripple_deg : float
        Amplitude, wavelength and direction of sine ripples.
    bumps : tuple of Bump
        Pits and mounds; heights add up.
    """

    seed: int = 0
    patches: tuple[Patch, ...] = ()
    step_db: float = 0.0
    step_deg: float = 0.0
    step_m: float = 0.0
    texture_db: float = 0.0
    texture_m: float = 1.0
    ripple_m: float = 0.0
    ripple_length_m: float = 0.3
    ripple_deg: float = 0.0
    bumps: tuple[Bump, ...] = ()

    def __post_init__(self) -> None:
        check_range("step_db", self.step_db, -60.0, 60.0, "dB")
        check_range("texture_db", self.texture_db, 0.0, 30.0, "dB")
        check_range("texture_m", self.texture_m, 0.0, 1e5, "m", open_low=True)
        check_range("ripple_m", self.ripple_m, 0.0, 1e3, "m")
        check_range("ripple_length_m", self.ripple_length_m, 0.0, 1e5, "m", open_low=True)

    @property
    def is_plain(self) -> bool:
        """Whether it is flat and of one level."""
        return not (self.has_levels or self.has_relief)

    @property
    def has_levels(self) -> bool:
        """Whether its level changes from place to place."""
        return bool(self.patches) or self.step_db != 0.0 or self.texture_db > 0.0

    @property
    def has_relief(self) -> bool:
        """Whether it is not flat."""
        return bool(self.bumps) or self.ripple_m > 0.0

    def amplitude(self, x: Any, y: Any) -> Any:
        """Return the amplitude at points over that of a plain seabed."""
        db = sum((patch.db(x, y) for patch in self.patches), np.zeros(np.broadcast(x, y).shape))
        if self.step_db != 0.0:
            turn = math.radians(self.step_deg)
            db = db + self.step_db * (x * math.cos(turn) + y * math.sin(turn) > self.step_m)
        if self.texture_db > 0.0:
            rng = np.random.default_rng([self.seed, 0x5E])
            wave = np.zeros(np.broadcast(x, y).shape)
            for _ in range(_TEXTURE_WAVES):
                # Wavelengths from the shortest to eight times it.
                k = 2.0 * math.pi / (self.texture_m * 8.0 ** rng.uniform())
                turn, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
                wave += np.cos(k * (x * math.cos(turn) + y * math.sin(turn)) + phase)
            db = db + self.texture_db * wave * math.sqrt(2.0 / _TEXTURE_WAVES)
        return 10.0 ** (db / 20.0)

    def height(self, x: Any, y: Any) -> Any:
        """Return the height (m) at points."""
        z = sum((bump.height(x, y) for bump in self.bumps), np.zeros(np.broadcast(x, y).shape))
        if self.ripple_m > 0.0:
            turn = math.radians(self.ripple_deg)
            along = x * math.cos(turn) + y * math.sin(turn)
            z = z + self.ripple_m * np.cos(2.0 * math.pi / self.ripple_length_m * along)
        return z


class SeabedModel:
    """A seabed made ready for an image and many sonar positions.

    Parameters
    ----------
    bed : Seabed
        What it is like.
    grid : GroundGrid
        Lattice of the image.
    """

    def __init__(self, bed: Seabed, grid: GroundGrid) -> None:
        self._bed, self._grid = bed, grid
        self._made: dict[tuple[int, int], tuple[Any, Any]] = {}
        if bed.has_relief:
            x, y = self._lattice(_RELIEF_POINTS, _RELIEF_POINTS)
            self._points = np.stack([*np.broadcast_arrays(x, y)], axis=-1)
            corners = np.dstack([self._points, bed.height(x, y)])
            a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]
            triangles = np.stack([np.stack([a, c, b], axis=2), np.stack([b, c, d], axis=2)], axis=2)
            try:
                self._occluded = embree_tracer(triangles.reshape(-1, 3, 3))
            except ImportError as error:  # trying each of that many triangles would take hours
                raise ParameterError(
                    "a seabed with relief needs embreex, which is not installed; expected a flat one here"
                ) from error

    def _lattice(self, rows: int, cols: int) -> tuple[FloatArray, FloatArray]:
        """Return x (1, cols) and y (rows, 1) of a lattice over the image, cell (0, 0) on pixel (0, 0)."""
        grid = self._grid
        x = grid.x_min_m + np.arange(cols) * (grid.cols * grid.spacing_m / cols)
        y = grid.y_max_m - np.arange(rows) * (grid.rows * grid.spacing_m / rows)
        return np.asarray(x[None, :], np.float64), np.asarray(y[:, None], np.float64)

    def _on(self, rows: int, cols: int) -> tuple[Any, Any]:
        """Return amplitude and height on a lattice over the image; None for what there is not."""
        if (rows, cols) not in self._made:
            x, y = self._lattice(rows, cols)
            level = self._bed.amplitude(x, y).astype(np.float32) if self._bed.has_levels else None
            height = self._bed.height(x, y).astype(np.float32) if self._bed.has_relief else None
            self._made[rows, cols] = level, height
        return self._made[rows, cols]

    def seen(self, sonar_m: FloatArray, lit: Any, window: tuple[slice, slice], rows: int, cols: int) -> Any:
        """Return the amplitude with which a sonar sees each cell of the seabed.

        Parameters
        ----------
        sonar_m : ndarray, shape (3,)
            Sonar position.
        lit : ndarray of float32, or None
            How much of each cell in `window` the sonar would light if the seabed were flat.
        window : (slice, slice)
            Rows and columns.
        rows, cols : int
            Cells along each axis, over the image's whole extent.

        Returns
        -------
        ndarray of float32, shape (rows, cols)
        """
        level, height = self._on(rows, cols)
        whole: Any = np.ones((rows, cols), np.float32)
        if lit is not None:
            whole[window] = lit
        if height is not None:
            tan = float(sonar_m[2] / math.hypot(sonar_m[0], sonar_m[1]))
            aspect = math.atan2(sonar_m[1], sonar_m[0])
            if lit is not None:
                reach = height * np.float32(tan + 1.0 / tan)
                per_col = cols / (self._grid.cols * self._grid.spacing_m)
                per_row = rows / (self._grid.rows * self._grid.spacing_m)
                u = np.arange(cols, dtype=np.float32)[None, :] - reach * np.float32(
                    math.cos(aspect) * per_col
                )
                v = np.arange(rows, dtype=np.float32)[:, None] + reach * np.float32(
                    math.sin(aspect) * per_row
                )
                whole = cv2.remap(
                    whole, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
                )
            whole *= cv2.resize(
                self._shade(sonar_m, tan, aspect), (cols, rows), interpolation=cv2.INTER_LINEAR
            )
        if level is not None:
            whole *= level
        return whole

    def _shade(self, sonar_m: FloatArray, tan: float, aspect: float) -> NDArray[np.float32]:
        """Return the relief's own brightness (amplitude over the flat seabed's), 0 where it hides itself."""
        bed = self._bed
        x, y = self._points[..., 0], self._points[..., 1]
        shift = bed.height(x, y) * tan
        x, y = x - shift * math.cos(aspect), y - shift * math.sin(aspect)
        z = bed.height(x, y)
        step = 2e-3
        slope_x = (bed.height(x + step, y) - z) / step
        slope_y = (bed.height(x, y + step) - z) / step
        ray = np.stack([sonar_m[0] - x, sonar_m[1] - y, sonar_m[2] - z], axis=-1)
        distance = np.linalg.norm(ray, axis=-1)
        steep = np.sqrt(1.0 + slope_x**2 + slope_y**2)
        cosine = (ray[..., 2] - slope_x * ray[..., 0] - slope_y * ray[..., 1]) / (distance * steep)
        flat = ray[..., 2] / distance
        amplitude = np.maximum(cosine, 0.0) * np.sqrt(steep) / flat
        origins = np.stack([x, y, z + _RAY_LIFT_M], axis=-1).reshape(-1, 3)
        away = (ray / distance[..., None]).reshape(-1, 3)
        amplitude *= ~self._occluded(origins, away).reshape(x.shape)
        return np.asarray(amplitude, np.float32)
