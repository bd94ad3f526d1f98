"""Which bags are meant by folders, globs and lists, and what tells one bag from another."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..bags.metadata import METADATA
from ..core.errors import BagError, ParameterError
from ..durable import sha256
from ..results.layout import looks_like_results
from .layout import ARCHIVE

_STORED = (".mcap", ".db3")
_PACKED = (".zstd", ".zst", ".lz4")


def _is_stored(name: str) -> bool:
    base, ending = os.path.splitext(name)
    return (os.path.splitext(base)[1] if ending in _PACKED else ending) in _STORED


def bags_of(sources: Iterable[str | Path]) -> list[Path]:
    """Return the bags that are meant, each once, in the order in which they are named.

    Parameters
    ----------
    sources : iterable of path-like
        A bag; a folder, of which every bag below is taken (bag folders, and lone storage files); a pattern
        (``*``, ``?``, ``[``, ``**``); or ``@FILE``, whose lines are such (empty ones and those
        after ``#`` are none). What is named and is not there is kept: it becomes a row that says so.

    Returns
    -------
    list of Path
        Absolute paths. Results folders, archives and hidden folders in a folder are left out.

    Raises
    ------
    ParameterError
        If a list cannot be read, or nothing is meant.

    Examples
    --------
    >>> from csas_shadow_ros.archive.sources import bags_of
    >>> [bag.name for bag in bags_of(["box_run", "box_r*", "gone_run"])]
    ['box_run', 'gone_run']
    """
    found = dict.fromkeys(Path(os.path.abspath(bag)) for source in sources for bag in _meant(str(source), 0))
    if not found:
        raise ParameterError("the sources hold no bag; expected folders with .mcap or .db3 files")
    return list(found)


def _meant(source: str, depth: int) -> Iterator[str]:
    if source.startswith("@") and depth < 8:  # a list may name lists, but not itself for ever
        file = Path(source[1:])
        try:
            lines = file.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise ParameterError(f"list {str(file)!r} cannot be read: {error}") from error
        for line in lines:
            if name := line.partition("#")[0].strip():
                # Names in a list are seen from the list.
                at, name = ("@", name[1:]) if name[0] == "@" else ("", name)
                yield from _meant(f"{at}{file.parent / name}", depth + 1)
    elif glob.has_magic(source) and not os.path.lexists(source):
        for path in sorted(glob.glob(source, recursive=True)):
            yield from _below(path, set(), named=False)
    else:
        yield from _below(source, set(), named=True)


def _below(path: str, seen: set[tuple[int, int]], *, named: bool) -> Iterator[str]:
    """Iterate the bags of a path: itself, or what is below it. Links are followed, but not in a circle."""
    if not os.path.isdir(path):
        if named or _is_stored(path):
            yield path
        return
    try:
        place = os.stat(path)
        if (place.st_dev, place.st_ino) in seen:
            return
        seen.add((place.st_dev, place.st_ino))
        with os.scandir(path) as listing:
            inside = sorted(listing, key=lambda entry: entry.name)
    except OSError:
        yield path  # whoever tries to read it will say why that cannot be
        return
    names = {entry.name for entry in inside}
    stored = [name for name in sorted(names) if _is_stored(name)]
    split = re.compile(rf"{re.escape(os.path.basename(os.path.abspath(path)))}_\d+\.")
    # Without its metadata a bag is known by what rosbag2 calls its files; others are a bag each.
    if METADATA in names or (stored and all(map(split.match, stored))):
        yield path
        return
    if ARCHIVE in names or looks_like_results(path):
        return
    some = False
    for entry in inside:
        if entry.name in stored or (entry.is_dir() and not entry.name.startswith(".")):
            for bag in _below(entry.path, seen, named=False):
                some = True
                yield bag
    if named and not some:
        yield path  # that it holds no bag is a row, not silence


def _files(bag: Path) -> list[Path]:
    """Return the files of a bag, those that sqlite3 writes beside a lone file too."""
    if bag.is_dir():
        return sorted(p for p in bag.iterdir() if p.is_file())
    return [bag, *(p for p in [bag.with_name(bag.name + "-wal")] if p.is_file())]


def signature_of(bag: Path) -> tuple[str, int]:
    """Return a hash of a bag's file names, sizes and times, and its bytes; nothing of it is read.

    Raises
    ------
    OSError
        If it is not there.
    """
    digest, size = hashlib.sha256(), 0
    for path in _files(bag):
        stat = path.stat()
        digest.update(f"{path.name}\0{stat.st_size}\0{stat.st_mtime_ns}\0".encode("utf-8", "surrogateescape"))
        size += stat.st_size
    return digest.hexdigest()[:32], size


def content_of(bag: Path) -> str:
    """Return the SHA-256 of what a bag holds, wherever it lies and whatever it is called.

    Raises
    ------
    BagError, OSError
        If it cannot be read.
    """
    digest = hashlib.sha256()
    files = _files(bag)
    if bag.is_dir() and not files:
        raise BagError(f"{bag} holds no file; expected a rosbag2 directory")
    for path in files:
        if not path.is_file():
            path.stat()  # says what is wrong where there is none
            raise BagError(f"{path} is not a file; expected a recording")
        name = path.name if bag.is_dir() else path.name.removeprefix(bag.name)
        digest.update(f"{name}\0{sha256(path)}\0".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()
