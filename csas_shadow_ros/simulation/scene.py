"""What a scene does to sound: the shadow that it casts and the echoes that it returns.

Shadow. A point p = (x, y, z) hides the seabed at p' = s_xy + (p_xy - s_xy) sz / (sz - z), seen from the sonar
s. The shadow of a scene is the union of its projected triangles; the half that faces the sonar
already covers it.

Echoes. Surfaces are rough: a fixed set of scatterers with complex Gaussian amplitudes, spread evenly over
the mesh. One of area dA returns power  ρ g cos²i dA,  ρ the seabed's power per square metre, g the
target's strength and i the angle of incidence (Lambert's law), if it faces the sonar and nothing hides
it. Cables are smooth instead: their scatterers are in phase, so they glint where they lie across the line
of sight and are dark elsewhere.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..core.errors import GeometryError
from ..core.geometry import GroundGrid
from .occlusion import make_tracer
from .raster import fill_triangles
from .targets import Scene, join_bodies

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SUPERSAMPLING = 4
_RAY_LIFT_M = 1e-3  # rays start this far off the surface, beyond the tracer's float32 rounding
_ECHO_MARGIN_PX = 4.0
#: Some 300 bytes each while they are drawn: 600 MB. A laying grid of 20 blocks on `samdis` takes a tenth.
_MOST_SCATTERERS = 2_000_000


def project_shadow(points_m: FloatArray, sonar_m: FloatArray) -> FloatArray:
    """Cast points along the rays from the sonar onto z = 0.

    Parameters
    ----------
    points_m : ndarray, shape (..., 3)
        Points under the sonar.
    sonar_m : ndarray, shape (3,)
        Sonar position.

    Returns
    -------
    ndarray, shape (..., 2)
        p' = s_xy + (p_xy - s_xy) sz / (sz - z).

    Raises
    ------
    GeometryError
        If a point is not under the sonar's height.
    """
    top = float(points_m[..., 2].max(initial=-math.inf))
    if not top < sonar_m[2]:
        raise GeometryError(f"scene reaches z = {top:g} m; expected under the sonar at {sonar_m[2]:g} m")
    scale = sonar_m[2] / (sonar_m[2] - points_m[..., 2:])
    return np.asarray(sonar_m[:2] + (points_m[..., :2] - sonar_m[:2]) * scale)


class SceneModel:
    """A scene made ready for many sonar positions.

    Parameters
    ----------
    scene : Scene
        What lies on the seabed.
    seed : int
        Of the scatterers.
    echo_db : float
        Target's scattering strength at normal incidence over the seabed's, both per area.
    scatterer_spacing_m : float
        Mean distance between scatterers.
    cable_db : float
        A cable's glint over the seabed's echo in a resolution cell of `cell_m`.
    cell_m : (float, float)
        That cell along range and cross-range.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int,
        echo_db: float,
        scatterer_spacing_m: float,
        cable_db: float,
        cell_m: tuple[float, float],
    ) -> None:
        rng = np.random.default_rng([seed, 0x7A])
        solids = [m for m in (scene.target, scene.decor) if len(m.faces)]
        self._has_solids = bool(solids)
        self._points: FloatArray = np.zeros((0, 3))
        self._normals: FloatArray = np.zeros((0, 3))
        self._amplitudes: ComplexArray = np.zeros(0, dtype=np.complex128)
        if self._has_solids:
            solid = join_bodies(solids)
            self._triangles = np.asarray(solid.triangles, dtype=np.float64)
            self._face_normals = np.asarray(solid.face_normals, dtype=np.float64)
            self._occluded = make_tracer(self._triangles)
            self._scatter_on(solid, rng, echo_db, scatterer_spacing_m)
        self._cables = np.concatenate(scene.cables) if scene.cables else np.zeros((0, 3))
        self._cable_amplitudes = self._cable_strength(scene.cables, cable_db, cell_m)

    @property
    def is_empty(self) -> bool:
        """True if nothing lies on the seabed."""
        return not self._has_solids and not len(self._cables)

    def _scatter_on(
        self, solid: trimesh.Trimesh, rng: np.random.Generator, echo_db: float, spacing_m: float
    ) -> None:
        needed = float(solid.area) / spacing_m**2
        if not needed <= _MOST_SCATTERERS:
            raise GeometryError(
                f"target has {solid.area:.3g} m² of surface, which take {needed:.2g} scatterers of"
                f" {spacing_m:.3g} m; expected at most {_MOST_SCATTERERS:.0e}: a mesh in metres"
            )
        count = max(64, math.ceil(needed))
        areas = solid.area_faces
        # Sampling by hand: the draws must depend on the seed alone, not on a library's version.
        faces = np.searchsorted(np.cumsum(areas), rng.uniform(0.0, areas.sum(), count))
        faces = np.minimum(faces, len(areas) - 1)
        r1, r2 = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
        a, b, c = (self._triangles[faces, i] for i in range(3))
        points = (1 - r1)[:, None] * a + (r1 * (1 - r2))[:, None] * b + (r1 * r2)[:, None] * c
        gaussian = np.empty(count, dtype=np.complex128)
        gaussian.real, gaussian.imag = rng.standard_normal((2, count)) / math.sqrt(2.0)
        normals = self._face_normals[faces]
        keep = normals[:, 2] > -0.999  # no sonar is under the scene
        power = 10.0 ** (echo_db / 10.0) * float(solid.area) / count
        self._points, self._normals = points[keep], normals[keep]
        self._amplitudes = math.sqrt(power) * gaussian[keep]

    @staticmethod
    def _cable_strength(
        cables: tuple[FloatArray, ...], cable_db: float, cell_m: tuple[float, float]
    ) -> FloatArray:
        """Return the amplitude of each point of in-phase cables.

        A cable across the line of sight adds up in phase over the length of a resolution cell; that sum is
        set against the seabed's power in the cell.
        """
        peak = math.sqrt(10.0 ** (cable_db / 10.0) * cell_m[0] * cell_m[1])
        strengths = [np.zeros(0)]
        for points in cables:
            step = float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())
            strengths.append(np.full(len(points), peak * step / cell_m[1]))
        return np.concatenate(strengths)

    def lit_fraction(self, sonar_m: FloatArray, grid: GroundGrid, rows: int, cols: int) -> Any:
        """Return how much of each cell of the seabed a sonar lights.

        Parameters
        ----------
        sonar_m : ndarray, shape (3,)
            Sonar position.
        grid : GroundGrid
            Lattice of the image.
        rows, cols : int
            Cells along each axis, over the image's whole extent; cell (0, 0) is centred on pixel (0, 0).

        Returns
        -------
        fraction : ndarray of float32, or None
            Lit fraction in the part of the image that holds all shadow; None if there is no shadow on it.
        window : (slice, slice)
            Rows and columns of that part.
        """
        none = (None, (slice(0, 0), slice(0, 0)))
        if not self._has_solids:
            return none
        facing = np.einsum("ij,ij->i", self._face_normals, sonar_m - self._triangles[:, 0]) > 0.0
        shadow = project_shadow(self._triangles[facing], sonar_m)
        uv = np.empty_like(shadow)
        uv[..., 0] = (shadow[..., 0] - grid.x_min_m) / grid.spacing_m * (cols / grid.cols)
        uv[..., 1] = (grid.y_max_m - shadow[..., 1]) / grid.spacing_m * (rows / grid.rows)
        low = np.maximum(np.floor(uv.min(axis=(0, 1)) + 0.5), 0).astype(int)
        high = np.minimum(np.ceil(uv.max(axis=(0, 1)) + 0.5), [cols, rows]).astype(int)
        if np.any(high <= low):
            return none
        s = SUPERSAMPLING
        drawn = np.zeros(((high[1] - low[1]) * s, (high[0] - low[0]) * s), dtype=np.uint8)
        # Sample j of cell i lies at i - 1/2 + (j + 1/2)/s cells.
        fill_triangles((uv - low + 0.5) * s - 0.5, drawn)
        cells = drawn.reshape(high[1] - low[1], s, high[0] - low[0], s).sum(axis=(1, 3), dtype=np.int32)
        fraction = 1.0 - cells.astype(np.float32) / np.float32(s * s)
        return fraction, (slice(low[1], high[1]), slice(low[0], high[0]))

    def echoes(
        self, sonar_m: FloatArray, aspect_rad: float, grid: GroundGrid
    ) -> tuple[FloatArray, ComplexArray]:
        """Return where a sonar sees echoes, and how strong.

        Parameters
        ----------
        sonar_m : ndarray, shape (3,)
            Sonar position.
        aspect_rad : float
            Aspect θ.
        grid : GroundGrid
            Lattice of the image; what is laid over beyond it is left out.

        Returns
        -------
        uv : ndarray, shape (n, 2)
            Image position (column, row) of each echo: (x, y) + z tan ψ û(θ).
        amplitude : ndarray of complex128, shape (n,)
            Relative to a seabed of unit power per square metre.
        """
        points, amplitude = self._visible(sonar_m)
        lines, line_amplitude = self._visible_cables(sonar_m)
        points, amplitude = np.concatenate([points, lines]), np.concatenate([amplitude, line_amplitude])
        tan_grazing = sonar_m[2] / math.hypot(sonar_m[0], sonar_m[1])
        layover = points[:, 2] * tan_grazing
        u = (points[:, 0] + layover * math.cos(aspect_rad) - grid.x_min_m) / grid.spacing_m
        v = (grid.y_max_m - points[:, 1] - layover * math.sin(aspect_rad)) / grid.spacing_m
        m = _ECHO_MARGIN_PX  # an image repeats beyond its border: keep echoes off it
        inside = (u > m) & (u < grid.cols - 1 - m) & (v > m) & (v < grid.rows - 1 - m)
        return np.column_stack([u, v])[inside], amplitude[inside]

    def _visible(self, sonar_m: FloatArray) -> tuple[FloatArray, ComplexArray]:
        if not len(self._points):
            return self._points, self._amplitudes
        ray = sonar_m - self._points
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        cosine = np.einsum("ij,ij->i", ray, self._normals)
        facing = cosine > 0.0
        points, cosine = self._points[facing], cosine[facing]
        free = self._unhidden(points + _RAY_LIFT_M * self._normals[facing], ray[facing])
        return points[free], (self._amplitudes[facing] * cosine)[free]

    def _visible_cables(self, sonar_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not len(self._cables) or not self._has_solids:
            return self._cables, self._cable_amplitudes
        ray = sonar_m - self._cables
        free = self._unhidden(self._cables, ray / np.linalg.norm(ray, axis=1)[:, None])
        return self._cables[free], self._cable_amplitudes[free]

    def _unhidden(self, origins: FloatArray, directions: FloatArray) -> NDArray[np.bool_]:
        return ~self._occluded(origins, directions)
