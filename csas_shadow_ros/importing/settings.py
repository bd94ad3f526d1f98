"""The page of geometry: what an image and its navigation do not say of themselves (docs/import.md)."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ..core.errors import CsasError

#: Axes that navigation may have, and what its three columns are called by default.
AXES: dict[str, tuple[str, str, str]] = {
    "scene": ("x", "y", "z"),
    "enu": ("east", "north", "up"),
    "ned": ("north", "east", "down"),
    "geographic": ("latitude", "longitude", "altitude"),
}
#: Parts of the page, their keys, and what each is: an error that names a lack says so.
KEYS: dict[str, dict[str, str]] = {
    "image": {
        "variable": "name of the complex array in the file",
        "real": "name of the array of real parts, where they are apart",
        "imag": "name of the array of imaginary parts",
        "rows": "where the first axis leads: south (the second east), north (the second east), east (north)",
        "spacing_m": "pixel (m)",
        "centre_m": "scene [x, y] of the middle of the image (m)",
        "corner_m": "scene [x, y] of the centre of the north-west pixel (m)",
        "stamp_ns": "when the last data of the image came (ns)",
    },
    "acoustics": {
        "centre_frequency_hz": "centre frequency (Hz)",
        "bandwidth_hz": "bandwidth (Hz)",
        "sound_speed_mps": "sound speed (m/s)",
        "spectrum_sign": "phase convention, 1 or -1 (docs/conventions.md)",
    },
    "track": {
        "file": "CSV file or bag of the navigation",
        "topic": "topic of a bag that holds the navigation",
        "frames": "[parent, sonar]: frames of a bag's transforms",
        "axes": f"one of {', '.join(AXES)}",
        "columns": "names of the CSV's columns, by what they hold",
        "time_unit": "s, ms, us, ns or iso",
        "origin_m": "the scene's origin on the seabed, [3] in the navigation's own axes (m)",
        "lever_arm_m": "where the sonar is, [3] in the vehicle's own axes (m)",
    },
    "origin": {
        "latitude_deg": "latitude of the scene's origin, WGS-84",
        "longitude_deg": "its longitude",
        "altitude_m": "altitude of the seabed there, over the ellipsoid (m)",
        "sigma_m": "its standard deviation along east and north (m)",
    },
}
FRAME = "frame"


class ImportSettingsError(CsasError, ValueError):
    """The page of geometry, or what it speaks of, lacks something or holds a wrong value."""


class Settings:
    """What a page of geometry holds.

    Parameters
    ----------
    values : mapping
        As YAML has it.
    name : str
        What it is called, for errors.
    folder : Path
        What paths in it are relative to.

    Raises
    ------
    ImportSettingsError
        If a part or a key is unknown.
    """

    def __init__(self, values: Mapping[str, Any], name: str = "geometry", folder: Path | None = None) -> None:
        self.name, self.folder = name, folder or Path()
        self.frame: str | None = None
        self._parts: dict[str, Mapping[str, Any]] = {}
        for part, held in values.items():
            if part == FRAME:
                if not isinstance(held, str):
                    raise ImportSettingsError(f"{name}: frame is {held!r}; expected the name of a frame")
                self.frame = held
                continue
            self._known("part", str(part), [*KEYS, FRAME])
            if not isinstance(held, Mapping):
                raise ImportSettingsError(f"{name}: {part} is {held!r}; expected keys and values")
            for key in held:
                self._known(f"key of {part}", str(key), list(KEYS[part]))
            self._parts[part] = held

    def _known(self, what: str, given: str, known: list[str]) -> None:
        if given not in known:
            near = difflib.get_close_matches(given, known, 1)
            expected = f"{near[0]!r}" if near else f"one of: {', '.join(known)}"
            raise ImportSettingsError(f"{self.name}: unknown {what} {given!r}; expected {expected}")

    def has(self, part: str, key: str | None = None) -> bool:
        """Say whether a part, or a key of one, is there."""
        return part in self._parts and (key is None or self._parts[part].get(key) is not None)

    def _value(self, part: str, key: str, default: Any) -> Any:
        value = self._parts.get(part, {}).get(key)
        if value is not None:
            return value
        if default is None:
            raise ImportSettingsError(f"{self.name} lacks {part}.{key}; expected the {KEYS[part][key]}")
        return default

    def wrong(self, part: str, key: str, expected: str) -> ImportSettingsError:
        """Return the error of a value that is no good."""
        value = self._parts.get(part, {}).get(key)
        return ImportSettingsError(f"{self.name}: {part}.{key} is {value!r}; expected {expected}")

    def number(self, part: str, key: str, default: float | None = None) -> float:
        """Return a number; an error if it is lacking and there is no default."""
        value = self._value(part, key, default)
        try:
            # YAML 1.1 takes 60e3 for a text.
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if isinstance(value, bool) or not math.isfinite(number):
            raise self.wrong(part, key, f"a number, the {KEYS[part][key]}")
        return number

    def numbers(self, part: str, key: str, count: int, default: list[float] | None = None) -> list[float]:
        """Return so many numbers."""
        values = self._value(part, key, default)
        try:
            numbers = [float(value) for value in values]
        except (TypeError, ValueError):
            numbers = []
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            raise self.wrong(part, key, f"{count} numbers, the {KEYS[part][key]}")
        return numbers

    def text(self, part: str, key: str, default: str | None = None) -> str:
        """Return a text."""
        value = self._value(part, key, default)
        if not isinstance(value, str):
            raise self.wrong(part, key, f"a text, the {KEYS[part][key]}")
        return value

    def whole(self, part: str, key: str) -> int:
        """Return a whole number."""
        value = self._value(part, key, None)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(part, key, f"a whole number, the {KEYS[part][key]}")
        return value

    def one_of(self, part: str, key: str, choices: list[str], default: str | None = None) -> str:
        """Return one of some words."""
        value = self.text(part, key, default)
        if value not in choices:
            raise self.wrong(part, key, f"one of: {', '.join(choices)}")
        return value

    def mapping(self, part: str, key: str) -> dict[str, str]:
        """Return names by names."""
        value = self._value(part, key, {})
        if not isinstance(value, Mapping) or not all(isinstance(v, str | int) for v in value.values()):
            raise self.wrong(part, key, f"names, the {KEYS[part][key]}")
        return {str(name): str(held) for name, held in value.items()}

    def names(self, part: str, key: str) -> tuple[str, str]:
        """Return two names."""
        value = self._value(part, key, None)
        if not isinstance(value, list) or len(value) != 2 or not all(isinstance(v, str) for v in value):
            raise self.wrong(part, key, f"two names, the {KEYS[part][key]}")
        return value[0], value[1]


def read_settings(path: str | Path) -> Settings:
    """Read a page of geometry.

    Raises
    ------
    ImportSettingsError
        If it cannot be read, or holds what is not known.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.NamedTemporaryFile("w", suffix=".yaml") as page:
    ...     _ = page.write("acoustics: {bandwidth_hz: 24e3}")
    ...     page.flush()
    ...     read_settings(page.name).number("acoustics", "bandwidth_hz")
    24000.0
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        why = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ImportSettingsError(f"{path} cannot be read: {why}; expected YAML") from error
    if not isinstance(values, Mapping):
        raise ImportSettingsError(f"{path} holds {type(values).__name__}; expected parts {', '.join(KEYS)}")
    return Settings(values, path.name, path.parent)
