"""Complex images as processors write them: NumPy, MATLAB, HDF5, GeoTIFF, SICD."""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..archive.extras import need
from ..core.geometry import Datum, GroundGrid
from .settings import ImportSettingsError, Settings

#: Where the first axis of an array leads, and what turns the array north up.
_TURNS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "south": lambda a: a,
    "north": lambda a: a[::-1],
    "east": lambda a: a.T[::-1],
}
#: Grid north may be off true north by what moves the image's edge by so many pixels.
_MOST_PIXELS_OFF = 0.5
#: Axes of a SICD image may be off east and north by so much (rad): 1 mm at 1 m, its own digits.
_MOST_OFF_AXIS = 1e-3


@dataclass(eq=False)
class FoundImage:
    """What a file holds.

    Parameters
    ----------
    pixels : ndarray of complex
        North up.
    grid : GroundGrid or None
        Its lattice in the scene, if the file tells it.
    datum : Datum or None
        Where the scene is, if the file tells it.
    """

    pixels: NDArray[Any]
    grid: GroundGrid | None = None
    datum: Datum | None = None


def read_image(path: Path, settings: Settings, datum: Datum | None) -> FoundImage:
    """Read the image of a file, by the ending of its name.

    Parameters
    ----------
    path : Path
        The file.
    settings : Settings
        Which variable it is, and how it lies.
    datum : Datum or None
        Where the scene is: a GeoTIFF on a chart is put round it.

    Raises
    ------
    ImportSettingsError
        If there is no complex image, or its lattice is none of ours.
    """
    readers: dict[str, Callable[[], FoundImage]] = {
        ".npy": lambda: _of_array(_npy(path), path, settings),
        ".npz": lambda: _of_array(_chosen(_npz(path), path, settings), path, settings),
        ".mat": lambda: _of_array(_mat(path, settings), path, settings),
        ".h5": lambda: _of_array(_hdf5(path, settings), path, settings),
        ".hdf5": lambda: _of_array(_hdf5(path, settings), path, settings),
        ".tif": lambda: _geotiff(path, settings, datum),
        ".tiff": lambda: _geotiff(path, settings, datum),
        ".ntf": lambda: _sicd(path, datum),
        ".nitf": lambda: _sicd(path, datum),
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ImportSettingsError(
            f"{path} ends with {path.suffix!r}; expected an image, one of: {' '.join(readers)}"
        )
    if not path.is_file():
        raise ImportSettingsError(f"there is no file {path}")
    return reader()


def _unreadable(path: Path, error: Exception, expected: str) -> ImportSettingsError:
    why = " ".join(str(error).split())
    if not why or isinstance(error, LookupError | AttributeError):
        why = f"{type(error).__name__} {why}".strip()  # a lone name says nothing
    return ImportSettingsError(f"{path} cannot be read: {why}; expected {expected}")


def _of_array(array: NDArray[Any], path: Path, settings: Settings) -> FoundImage:
    pixels = np.asarray(array)
    if pixels.ndim != 2 or not np.iscomplexobj(pixels):
        raise ImportSettingsError(
            f"{path} holds an array {pixels.shape} of {pixels.dtype}; expected a complex image of two axes"
            " (or image.real and image.imag)"
        )
    turn = _TURNS[settings.one_of("image", "rows", list(_TURNS), "south")]
    return FoundImage(np.ascontiguousarray(turn(pixels)))


def _npy(path: Path) -> NDArray[Any]:
    try:
        array: NDArray[Any] = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise _unreadable(path, error, "a NumPy array") from error
    return array


def _npz(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as held:
            return {name: held[name] for name in held.files}
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise _unreadable(path, error, "NumPy arrays") from error


def _chosen(held: Mapping[str, Any], path: Path, settings: Settings) -> NDArray[Any]:
    """Return the variable that is named; else the only one that is a complex image."""

    def named(key: str) -> NDArray[Any]:
        name = settings.text("image", key)
        if name not in held:
            raise ImportSettingsError(f"{path} has no {name!r}; expected one of: {', '.join(held) or 'none'}")
        return np.asarray(held[name])

    if settings.has("image", "real") or settings.has("image", "imag"):
        real, imag = named("real"), named("imag")
        if real.shape != imag.shape:
            raise ImportSettingsError(
                f"{path}: real parts are {real.shape}, imaginary ones {imag.shape}; expected one shape"
            )
        return np.asarray(real + 1j * imag, np.result_type(real, imag, np.complex64))
    if settings.has("image", "variable"):
        return named("variable")
    complex_ones = {
        name: one for name, one in held.items() if np.iscomplexobj(one) and np.asarray(one).ndim == 2
    }
    if len(complex_ones) != 1:
        several = ", ".join(complex_ones) or "none"
        raise ImportSettingsError(
            f"{settings.name} lacks image.variable, and complex images in {path} are: {several};"
            f" it holds {', '.join(held) or 'nothing'}"
        )
    return np.asarray(next(iter(complex_ones.values())))


def _mat(path: Path, settings: Settings) -> NDArray[Any]:
    from scipy.io import loadmat

    try:
        held = {name: one for name, one in loadmat(path).items() if not name.startswith("__")}
    except NotImplementedError:  # version 7.3 is HDF5, whose arrays MATLAB stores by columns
        return _hdf5(path, settings).T
    except (OSError, ValueError, TypeError, KeyError, EOFError) as error:
        raise _unreadable(path, error, "a MAT-file") from error
    return _chosen(held, path, settings)


def _hdf5(path: Path, settings: Settings) -> NDArray[Any]:
    h5py = need("h5py", "import from HDF5", "import")
    held: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim == 2:
            # MATLAB stores complex numbers as pairs called real and imag, h5py as r and i.
            pairs = item.dtype.names
            held[name] = item if pairs is None else item[...]
            if pairs is not None and len(pairs) == 2:
                real, imag = (held[name][one] for one in pairs)
                held[name] = np.asarray(real + 1j * imag, np.result_type(real, imag, np.complex64))

    try:
        with h5py.File(path) as file:
            file.visititems(take)
            complex_or_named = {name: one[...] for name, one in held.items() if _wanted(name, one, settings)}
            return _chosen(complex_or_named or dict.fromkeys(held, np.zeros(0)), path, settings)
    except OSError as error:
        raise _unreadable(path, error, "HDF5") from error


def _wanted(name: str, item: Any, settings: Settings) -> bool:
    """Say whether a dataset may be the image: others, which may be large, are not read."""
    named = [settings.text("image", k) for k in ("variable", "real", "imag") if settings.has("image", k)]
    return name in named if named else np.issubdtype(item.dtype, np.complexfloating)


def _geotiff(path: Path, settings: Settings, datum: Datum | None) -> FoundImage:
    rasterio = need("rasterio", "import from GeoTIFF", "import")
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as file:
                bands = file.read()
                transform, crs = file.transform, file.crs
    except (OSError, RasterioError) as error:
        raise _unreadable(path, error, "a GeoTIFF") from error
    if len(bands) == 2 and not np.iscomplexobj(bands):
        bands = (bands[0] + 1j * bands[1])[None]  # real and imaginary parts as two bands
    if len(bands) != 1:
        raise ImportSettingsError(f"{path} has {len(bands)} bands; expected a complex one, or two real ones")
    found = _of_array(bands[0], path, settings)
    if transform.is_identity or settings.has("image", "spacing_m"):
        return found
    a, b, c, d, e, f = tuple(transform)[:6]
    if b or d or a <= 0 or e >= 0 or not math.isclose(a, -e, rel_tol=1e-6):
        raise ImportSettingsError(
            f"{path} has the transform {[a, b, c, d, e, f]}; expected square pixels, north up"
        )
    if crs is not None and crs.is_geographic:
        raise ImportSettingsError(f"{path} is in degrees; expected a chart in metres")
    middle = c + a * bands.shape[2] / 2, f + e * bands.shape[1] / 2
    east, north = (
        (0.0, 0.0) if crs is None or not crs.is_projected else _on_chart(path, crs, datum, middle, a)
    )
    rows, cols = found.pixels.shape
    found.grid = GroundGrid(rows, cols, a, c + a / 2 - east, f + e / 2 - north)
    return found


def _on_chart(
    path: Path, crs: Any, datum: Datum | None, middle: tuple[float, float], pixel: float
) -> tuple[float, float]:
    """Return where the scene's origin is on a chart; refuse one whose grid is turned or of another scale."""
    from rasterio.warp import transform as warp

    if datum is None:
        raise ImportSettingsError(
            f"{path} is on a chart ({crs.to_string()[:40]}); expected origin.latitude_deg and"
            " origin.longitude_deg, where the scene's origin is on it"
        )
    reach = max(math.dist(middle, _point(warp, crs, datum, 0.0, 0.0)), 100.0)
    here, right, up = (_point(warp, crs, datum, *at) for at in ((0.0, 0.0), (reach, 0.0), (0.0, reach)))
    off = max(
        abs(value)
        for value in (
            right[0] - here[0] - reach,
            right[1] - here[1],
            up[0] - here[0],
            up[1] - here[1] - reach,
        )
    )
    if off > _MOST_PIXELS_OFF * pixel * max(1.0, reach / 100.0):
        raise ImportSettingsError(
            f"{path}: axes of its chart are {off:.3g} m off east and north {reach:.0f} m from the origin;"
            " expected a chart of the place itself, as a transverse Mercator projection through the origin"
        )
    return here


def _point(warp: Any, crs: Any, datum: Datum, x: float, y: float) -> tuple[float, float]:
    latitude, longitude = datum.to_latlon(x, y)
    (east,), (north,) = warp("EPSG:4326", crs, [longitude], [latitude])
    return float(east), float(north)


@dataclass(frozen=True, eq=False)
class _Sicd:
    """What is read of a SICD file.

    Parameters
    ----------
    pixels : ndarray of complex
        As they are stored.
    plane : str
        What the image lies in.
    steps_m : (float, float)
        Pixel spacing down and across.
    axes_earth : (ndarray, ndarray)
        Where rows and columns lead, earth-centred unit vectors.
    point_lla : (float, float, float)
        Latitude, longitude (deg) and height of the reference point.
    point_px : ndarray, shape (2,)
        Row and column of that point, counted from the first ones that are stored.
    """

    pixels: NDArray[Any]
    plane: str
    steps_m: tuple[float, float]
    axes_earth: tuple[NDArray[Any], NDArray[Any]]
    point_lla: tuple[float, float, float]
    point_px: NDArray[Any]


def _read_sicd(path: Path) -> _Sicd:
    sicd = need("sarkit.sicd", "import from SICD", "import")
    try:
        with path.open("rb") as file, sicd.NitfReader(file) as reader:
            helper = sicd.XmlHelper(reader.metadata.xmltree)
            pixels = reader.read_image()

            def load(name: str) -> Any:
                value = helper.load(f"{{*}}{name}")
                if value is None:
                    raise ImportSettingsError(
                        f"{path} lacks {name}; expected a SICD with a ground-plane grid"
                    )
                return value

            def of_axes(name: str) -> tuple[Any, Any]:
                down, across = (load(name.format(axis)) for axis in ("Row", "Col"))
                return down, across

            plane = load("Grid/{*}ImagePlane")
            steps = of_axes("Grid/{{*}}{}/{{*}}SS")
            axes = of_axes("Grid/{{*}}{}/{{*}}UVectECF")
            latitude, longitude, altitude = map(float, load("GeoData/{*}SCP/{*}LLH"))
            point = np.asarray(load("ImageData/{*}SCPPixel"), float)
            first = np.asarray(of_axes("ImageData/{{*}}First{}"), float)
            return _Sicd(
                pixels,
                plane,
                (float(steps[0]), float(steps[1])),
                (np.asarray(axes[0], float), np.asarray(axes[1], float)),
                (latitude, longitude, altitude),
                point - first,
            )
    except ImportSettingsError:
        raise
    except Exception as error:  # sarkit lets through whatever its parsers meet
        raise _unreadable(path, error, "a SICD NITF") from error


#: Directions in a scene, east north up.
_DIRECTIONS = {"south": (0, -1, 0), "north": (0, 1, 0), "east": (1, 0, 0), "west": (-1, 0, 0)}
#: Where rows and columns of a stored image lead; what turns it north up; whether a place along either axis of
#: the stored image is counted from its first (1) or its last pixel (-1) then.
_TURNS_OF_AXES: dict[tuple[str, str], tuple[Callable[[NDArray[Any]], NDArray[Any]], tuple[int, int]]] = {
    ("south", "east"): (lambda a: a, (1, 1)),
    ("south", "west"): (lambda a: a[:, ::-1], (1, -1)),
    ("north", "east"): (lambda a: a[::-1], (-1, 1)),
    ("north", "west"): (lambda a: a[::-1, ::-1], (-1, -1)),
    ("east", "south"): (lambda a: a.T, (1, 1)),
    ("east", "north"): (lambda a: a.T[::-1], (1, -1)),
    ("west", "south"): (lambda a: a.T[:, ::-1], (-1, 1)),
    ("west", "north"): (lambda a: a.T[::-1, ::-1], (-1, -1)),
}


def _directions_of(axes: Sequence[NDArray[Any]], path: Path) -> tuple[str, str]:
    """Return which way rows and columns lead; refuse an image that is turned against north."""
    lies = [
        next((n for n, to in _DIRECTIONS.items() if np.abs(axis - to).max() < _MOST_OFF_AXIS), "")
        for axis in axes
    ]
    if (lies[0], lies[1]) not in _TURNS_OF_AXES:
        told = [axis.round(4).tolist() for axis in axes]
        raise ImportSettingsError(
            f"{path}: rows lead to {told[0]}, columns to {told[1]} (east, north, up); expected one along east"
            " or west, the other along north or south"
        )
    return lies[0], lies[1]


def _sicd(path: Path, datum: Datum | None) -> FoundImage:
    """Read a SICD on the ground plane; without a datum its reference point is the scene's origin."""
    found = _read_sicd(path)
    if found.plane != "GROUND":
        raise ImportSettingsError(
            f"{path} has its image in the {found.plane} plane; expected the GROUND plane"
        )
    step, other = found.steps_m
    if not math.isclose(step, other, rel_tol=1e-6):
        raise ImportSettingsError(f"{path} has pixels of {step:g} m by {other:g} m; expected square ones")
    latitude, longitude, altitude = found.point_lla
    datum = datum or Datum(latitude, longitude, altitude_m=altitude)
    x, y = datum.to_scene(latitude, longitude)
    rotation, _ = datum.scene_to_earth
    lies = _directions_of([np.asarray(rotation.T @ axis) for axis in found.axes_earth], path)
    turn, signs = _TURNS_OF_AXES[lies]
    at = [
        k if sign > 0 else n - 1 - k
        for k, n, sign in zip(found.point_px, found.pixels.shape, signs, strict=True)
    ]
    col, row = (at[1], at[0]) if lies[0] in ("south", "north") else (at[0], at[1])
    array = np.ascontiguousarray(turn(found.pixels)).astype(np.complex64, copy=False)
    rows, cols = array.shape
    grid = GroundGrid(rows, cols, step, x - col * step, y + row * step)
    return FoundImage(array, grid, datum)
