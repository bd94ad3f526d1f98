"""Tiny runs for archives: sound ones that are all different, and ones that are broken in many ways."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from csas_shadow_ros.bags import write_run
from csas_shadow_ros.core.geometry import CoherentImage, Track
from csas_shadow_ros.simulation import SimulatedRun

HOUR_NS = 3_600_000_000_000


def later(run: SimulatedRun, number: int, gain: float = 1.0) -> tuple[CoherentImage, Track]:
    """Return a run as it would have been so many hours later: all stamps differ, and so the bag."""
    image = dataclasses.replace(
        run.image,
        pixels=(run.image.pixels * np.float32(gain)),
        stamp_ns=run.image.stamp_ns + number * HOUR_NS,
    )
    return image, Track(run.track.stamps_ns + number * HOUR_NS, run.track.positions_m)


def sound(run: SimulatedRun, path: Path, number: int) -> Path:
    """Write a sound bag, unlike those of other numbers."""
    write_run(path, *later(run, number))
    return path


def _data(bag: Path) -> Path:
    (data,) = bag.glob("*.mcap")
    return data


def _cut(bag: Path) -> None:
    data = _data(bag).read_bytes()
    _data(bag).write_bytes(data[:2000])


def _without_data(bag: Path) -> None:
    _data(bag).unlink()


def _garbage(bag: Path) -> None:
    _data(bag).write_bytes(bytes(range(256)) * 40)


def _emptied(bag: Path) -> None:
    _data(bag).write_bytes(b"")


def _swapped(bag: Path) -> None:
    """Leave a bag with a folder where its file should be."""
    data = _data(bag)
    data.unlink()
    data.mkdir()


def _no_bag(bag: Path) -> None:
    shutil.rmtree(bag)
    bag.mkdir()
    (bag / "readme.mcap").write_text("nothing recorded, the disk was full")


#: What is done to a bag after it was written.
DAMAGES: dict[str, Callable[[Path], None]] = {
    "cut": _cut,
    "without_data": _without_data,
    "garbage": _garbage,
    "emptied": _emptied,
    "swapped": _swapped,
    "no_bag": _no_bag,
}


def _half_track(image: CoherentImage, track: Track) -> tuple[CoherentImage, Track | None]:
    return image, Track(track.stamps_ns[:3], track.positions_m[:3])


def _no_track(image: CoherentImage, track: Track) -> tuple[CoherentImage, Track | None]:
    return image, None


def _no_image(image: CoherentImage, track: Track) -> tuple[CoherentImage | None, Track]:
    return None, track


def _wrong_sign(image: CoherentImage, track: Track) -> tuple[CoherentImage, Track]:
    acoustics = dataclasses.replace(image.acoustics, spectrum_sign=-image.acoustics.spectrum_sign)
    return dataclasses.replace(image, acoustics=acoustics), track


#: What is wrong with a run before it is written.
FAULTS: dict[str, Callable[[CoherentImage, Track], tuple[CoherentImage | None, Track | None]]] = {
    "half_track": _half_track,
    "no_track": _no_track,
    "no_image": _no_image,
    "wrong_sign": _wrong_sign,
}
KINDS = [*DAMAGES, *FAULTS]


def broken(run: SimulatedRun, path: Path, kind: str, number: int) -> Path:
    """Write a bag that is broken in a way of `KINDS`."""
    image, track = later(run, number)
    if kind in FAULTS:
        write_run(path, *FAULTS[kind](image, track))
    else:
        write_run(path, image, track)
        DAMAGES[kind](path)
    return path
