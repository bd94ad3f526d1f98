"""What of a results folder goes on a chart."""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters.pairs import ground_picture_from_msgs, view_from_msgs

from ..archive.rows import datum_of, rows_of_report
from ..bags import BagReader, iterate_pairs
from ..core.errors import CsasError, ParameterError
from ..core.geometry import Datum, GroundGrid, View, ViewInfo
from ..core.imaging.composites import Composites
from ..core.imaging.mask_codes import MASK_SHADOW
from ..core.parameters import PlaceParameters
from ..core.shape.mesh import Dimensions
from ..core.shape.result import Quality, Result
from ..core.shape.volume import Volume, VoxelGrid
from ..results.bag import ResultBag
from ..results.layout import read_report


class MapError(CsasError):
    """Something of a run cannot go on a chart."""


@dataclasses.dataclass(frozen=True, eq=False)
class Raster:
    """A picture of the ground.

    Parameters
    ----------
    name : str
        What it is called.
    about : str
        What its values are.
    grid : GroundGrid
        Its lattice in the scene.
    pixels : ndarray of float32 (rows, cols) or of uint8 (rows, cols, 3)
        NaN, or black, where nothing is known.
    unit : str
        Of its values.
    """

    name: str
    about: str
    grid: GroundGrid
    pixels: NDArray[Any]
    unit: str = ""


class MapSource:
    """Reads a results folder.

    Parameters
    ----------
    folder : path-like
        The folder.
    place : PlaceParameters, optional
        Where its scene is, instead of what the run was told.

    Raises
    ------
    ResultsError
        If it is no results folder.
    MapError
        If its report cannot be understood.
    """

    def __init__(self, folder: str | Path, place: PlaceParameters | None = None) -> None:
        self.folder = Path(folder)
        self.report = read_report(folder)
        #: Why what is not there is not, by its name.
        self.lacking: dict[str, str] = {}
        try:
            said = datum_of(self.report)
            self.datum: Datum | None = said if place is None else place.datum(said)
            self.contacts = self._contacts()
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, ParameterError):
                raise
            raise MapError(
                f"report.json of {folder} cannot be understood: {type(error).__name__}: {error}"
            ) from error

    @property
    def frame(self) -> str:
        """Name of the scene's frame."""
        return str(self.report.get("frame") or "csas_scene")

    def _contacts(self) -> list[dict[str, Any]]:
        """Return a row an object, as the catalogue has it, in this datum."""
        entries = []
        for entry in self.report["objects"]:
            place = None if self.datum is None else self.datum.place_of(dimensions_of(entry))
            entries.append({**entry, "place": None if place is None else vars(place)})
        datum = None if self.datum is None else dataclasses.asdict(self.datum)
        report = {**self.report, "objects": entries, "datum": datum}
        base = {"task": str(self.folder), "bag": "", "name": "", "number": 1}
        _, contacts = rows_of_report(report, base, self.folder.name)
        for contact, entry in zip(contacts, entries, strict=True):
            sigmas = entry["place"] or {}
            contact |= {name: finite(sigmas.get(name)) for name in ("sigma_east_m", "sigma_north_m")}
        return contacts

    def corners_m(self, contact: Mapping[str, Any]) -> list[tuple[float, float]]:
        """Return the scene (x, y) of the corners of an object's plan, counter-clockwise."""
        x, y = contact["x_m"], contact["y_m"]
        a, b = contact["length_m"] / 2.0, contact["width_m"] / 2.0
        heading = math.radians(contact["heading_deg"])
        c, s = math.cos(heading), math.sin(heading)
        return [(x + c * u - s * v, y + s * u + c * v) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b))]

    # -- pictures ------------------------------------------------------------------------------------

    @cached_property
    def _reader(self) -> BagReader | None:
        try:
            return BagReader(self.folder / ResultBag.FILE)
        except CsasError:
            return None

    def _attempt(self, name: str, make: Callable[[], Raster]) -> Raster | None:
        try:
            return make()
        except (CsasError, OSError) as error:
            self.lacking[name] = str(error)
            return None

    @cached_property
    def rasters(self) -> list[Raster]:
        """Pictures of the ground that the folder holds; what it does not hold is `lacking`."""
        wanted: dict[str, Callable[[], Raster]] = {
            "multilook": lambda: self._composite("multilook", "multi-look amplitude over the circle"),
            "color_by_aspect": lambda: self._composite(
                "color_by_aspect", "hue by the aspect that an echo is seen from"
            ),
            "shadow_free": self._shadow_free,
        }
        made = [self._attempt(name, make) for name, make in wanted.items()]
        return [one for one in made if one is not None] + self._heights()

    def _bag(self) -> BagReader:
        if self._reader is None:
            raise MapError(f"{self.folder} has no {ResultBag.FILE} that can be read; expected a run with it")
        return self._reader

    def _composite(self, name: str, about: str) -> Raster:
        picture = None
        for pair in iterate_pairs(self._bag(), name, lambda _: None):
            picture = ground_picture_from_msgs(pair.image, pair.info, name)  # the newest counts
        if picture is None:
            raise MapError(f"{ResultBag.FILE} of {self.folder} holds no {name}/image")
        info, pixels = picture
        return Raster(name, about, info.grid, pixels)

    def _shadow_free(self) -> Raster:
        """Make the multi-look amplitude over those views in which the pixel is in no target's shadow."""
        reader = self._bag()
        masks: dict[int, tuple[ViewInfo, NDArray[np.uint8]]] = {}
        for view in self._views(reader, "shadow_mask"):
            # Bits: hundreds of masks are kept until their views come.
            masks[view.info.stamp_ns] = view.info, np.packbits(view.pixels == MASK_SHADOW)
        if not masks:
            raise MapError(f"{ResultBag.FILE} of {self.folder} holds no shadow_mask views")
        grid = self._composite("multilook", "").grid
        composites = Composites(grid)
        for stream in ("sub_aperture", "shadow"):
            for view in self._views(reader, stream):
                if (known := masks.get(view.info.stamp_ns)) is not None:
                    composites.integrate(_without(view, *known))
            if composites.stamps:
                return Raster(
                    "shadow_free",
                    "multi-look amplitude over the views in which the pixel is in no target's shadow",
                    grid,
                    composites.multilook(),
                )
        raise MapError(f"{ResultBag.FILE} of {self.folder} holds no views that its shadow masks are of")

    def _views(self, reader: BagReader, stream: str) -> Any:
        for pair in iterate_pairs(reader, stream, lambda _: None):
            yield view_from_msgs(pair.image, pair.info, stream)

    def _heights(self) -> list[Raster]:
        rasters = []
        for entry in self.report["objects"]:
            number, file = entry["number"], entry["files"][0]
            name = "height" if file == "grid.npz" else f"height_{number}"
            made = self._attempt(name, lambda n=name, f=file: self._height(n, f))  # type: ignore[misc]
            rasters += [made] if made is not None else []
        return rasters

    def _height(self, name: str, file: str) -> Raster:
        grid, _ = read_grid(self.folder / file)
        volume, d = grid.volume, grid.volume.voxel_size_m
        nz, ny, nx = volume.shape
        highest = nz - 1 - grid.occupied[::-1].argmax(axis=0)
        top = np.where(grid.occupied.any(axis=0), volume.z_m[highest] + d / 2.0, np.nan)
        ground = GroundGrid(ny, nx, d, volume.origin_m[0], float(volume.y_m[-1]))
        about = "height of the object's carved top over the seabed"
        return Raster(name, about, ground, np.ascontiguousarray(top[::-1], dtype=np.float32), "m")

    # -- the grid ------------------------------------------------------------------------------------

    def result(self) -> Result:
        """Return what the folder holds of its target: grid, matter, dimensions, verdict and place.

        Raises
        ------
        MapError
            If the grid cannot be read.
        """
        report, target = self.report, None
        method = str((report.get("grid") or report).get("method") or "consensus")
        grid, matter = read_grid(self.folder / "grid.npz", method)
        for entry in report["objects"]:
            if entry["files"][0] == "grid.npz":
                target = dimensions_of(entry)
        quality = Quality(report["quality"]["verdict"], tuple(report["quality"]["reasons"]))
        return Result(
            run_ns=report.get("run"),
            verdict=report["verdict"],
            quality=quality,
            grid=grid,
            matter=matter,
            dimensions=target,
            views_used=report["views"]["used"],
            frame=self.frame,
            datum=self.datum,
        )


def _without(view: View, mask: ViewInfo, bits: NDArray[np.uint8]) -> View:
    """Return a view's amplitude, NaN where a mask of the same stamp says shadow."""
    camera = mask.camera
    dark: Any = np.unpackbits(bits, count=camera.rows * camera.cols).reshape(camera.shape)
    to_mask = camera.ground_to_pixel @ view.info.camera.pixel_to_ground
    if camera.shape != view.pixels.shape or not np.allclose(to_mask, np.eye(3), atol=1e-3):
        # Masks may come from elsewhere, on a lattice of their own.
        size = (view.pixels.shape[1], view.pixels.shape[0])
        dark = cv2.warpAffine(dark, to_mask[:2], size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    amplitude = np.abs(view.pixels).astype(np.float32, copy=False)
    amplitude[dark > 0] = np.nan
    return dataclasses.replace(view, pixels=amplitude)


def finite(value: Any) -> float | None:
    """Return a number; None where it is not known."""
    return None if value is None or not math.isfinite(value) else float(value)


def dimensions_of(entry: Mapping[str, Any]) -> Dimensions:
    """Return the measures of an object of a report."""
    told = entry["dimensions"]
    names = {field.name for field in dataclasses.fields(Dimensions)} - {"intervals", "position_m"}
    values = {name: math.nan if told.get(name) is None else float(told[name]) for name in names}
    intervals = {
        name: (float(low), float(high))
        for name, (low, high) in (told.get("intervals") or {}).items()
        if low is not None and high is not None
    }
    x, y = entry["position_m"][:2]
    return Dimensions(**values, position_m=(float(x), float(y)), intervals=intervals)


def read_grid(path: Path, method: str = "consensus") -> tuple[VoxelGrid, NDArray[np.bool_]]:
    """Read ``grid.npz`` or ``object_N.npz``: the grid, and where matter is.

    Raises
    ------
    MapError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file, np.load(file) as data:
            origin, size = data["origin_m"], float(data["voxel_size_m"])
            likelihood = data["likelihood"]
            volume = Volume((float(origin[0]), float(origin[1]), float(origin[2])), size, likelihood.shape)
            grid = VoxelGrid(
                volume, likelihood, data["views"], float(data["threshold"]), data["occupied"], method
            )
            return grid, data.get("matter", grid.occupied)
    except (OSError, KeyError, ValueError, EOFError, BadZipFile, zlib.error) as error:
        raise MapError(f"{path} cannot be read: {error}") from error
