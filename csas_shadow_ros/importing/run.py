"""A run's bag from an image, navigation and a page of geometry."""

from __future__ import annotations

from pathlib import Path

from ..bags import write_run
from ..core.frame_name import SCENE_FRAME
from ..core.geometry import Acoustics, CoherentImage, Datum, GroundGrid
from .images import FoundImage, read_image
from .navigation import read_track
from .settings import ImportSettingsError, Settings, read_settings


def import_run(
    source: str | Path,
    out: str | Path,
    geometry: str | Path,
    *,
    track: str | Path | None = None,
    encoding: str = "32FC2",
    overwrite: bool = False,
) -> Path:
    """Make a run's bag of what another processor wrote.

    Parameters
    ----------
    source : path-like
        The full-circle complex image: NumPy, MATLAB, HDF5, GeoTIFF or SICD, by the ending of its name.
    out : path-like
        The bag to make.
    geometry : path-like
        A YAML file that tells what the image and the navigation do not (docs/import.md).
    track : path-like, optional
        The navigation, instead of ``track.file`` of the geometry.
    encoding : str
        As of `write_run`.
    overwrite : bool
        Replace a bag that is there.

    Returns
    -------
    Path
        The bag.

    Raises
    ------
    CsasError
        If something is lacking or wrong; the message says what.

    Examples
    --------
    >>> import tempfile, numpy, yaml
    >>> import csas_shadow_ros as csas
    >>> from csas_shadow_ros.importing import import_run
    >>> made, folder = csas.simulate("tiny"), tempfile.mkdtemp()
    >>> numpy.save(f"{folder}/image.npy", made.image.pixels)
    >>> numpy.savetxt(
    ...     f"{folder}/nav.csv",
    ...     numpy.column_stack([made.track.stamps_ns / 1e9, made.track.positions_m]),
    ...     delimiter=",", header="time,x,y,z", comments="", fmt="%.6f",
    ... )
    >>> page = {
    ...     "image": {"spacing_m": made.image.grid.spacing_m},
    ...     "acoustics": {
    ...         "centre_frequency_hz": 60e3, "bandwidth_hz": 24e3, "sound_speed_mps": 1500,
    ...         "spectrum_sign": 1,
    ...     },
    ...     "track": {"file": "nav.csv", "axes": "scene"},
    ... }
    >>> with open(f"{folder}/geometry.yaml", "w") as file:
    ...     yaml.safe_dump(page, file)
    >>> bag = import_run(f"{folder}/image.npy", f"{folder}/bag", f"{folder}/geometry.yaml")
    >>> print(csas.read_run(bag).track)
    Track: 720 poses over 360.0° of the circle, radius 30.00 m, height 12.00 m, 0 gaps
    """
    settings = read_settings(geometry)
    datum = _datum(settings)
    # What is small first: a slip in the page is told before gigabytes are read.
    frequency, bandwidth, speed = (settings.number("acoustics", name) for name in _BAND)
    acoustics = Acoustics(frequency, bandwidth, speed, settings.whole("acoustics", "spectrum_sign"))
    if datum is None and Path(source).suffix.lower() in (".ntf", ".nitf"):
        found = read_image(Path(source), settings, datum)
        datum = found.datum
        sonar = read_track(settings, datum, None if track is None else Path(track))
    else:
        sonar = read_track(settings, datum, None if track is None else Path(track))
        found = read_image(Path(source), settings, datum)
    image = CoherentImage(
        found.pixels,
        _grid(found, settings, Path(source)),
        acoustics,
        settings.whole("image", "stamp_ns")
        if settings.has("image", "stamp_ns")
        else int(sonar.stamps_ns[-1]),
        frame=settings.frame or SCENE_FRAME,
    )
    return write_run(out, image, sonar, encoding=encoding, overwrite=overwrite, datum=datum)


_BAND = ("centre_frequency_hz", "bandwidth_hz", "sound_speed_mps")


def _datum(settings: Settings) -> Datum | None:
    if not settings.has("origin"):
        return None
    covariance = None
    if settings.has("origin", "sigma_m"):
        variance = settings.number("origin", "sigma_m") ** 2
        covariance = variance, variance, 0.0
    return Datum(
        settings.number("origin", "latitude_deg"),
        settings.number("origin", "longitude_deg"),
        altitude_m=settings.number("origin", "altitude_m", 0.0),
        covariance_m2=covariance,
    )


def _grid(found: FoundImage, settings: Settings, source: Path) -> GroundGrid:
    if found.grid is not None:
        for key in ("spacing_m", "centre_m", "corner_m"):
            if settings.has("image", key):
                raise settings.wrong("image", key, f"none: {source} tells its own lattice")
        return found.grid
    rows, cols = found.pixels.shape
    spacing = settings.number("image", "spacing_m")
    if settings.has("image", "corner_m"):
        if settings.has("image", "centre_m"):
            raise ImportSettingsError(
                f"{settings.name} has image.centre_m and image.corner_m; expected one of them"
            )
        x, y = settings.numbers("image", "corner_m", 2)
        return GroundGrid(rows, cols, spacing, x, y)
    x, y = settings.numbers("image", "centre_m", 2, [0.0, 0.0])
    return GroundGrid.centred(rows, cols, spacing, (x, y))
