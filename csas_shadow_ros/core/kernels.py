"""Compiled kernels and their folder: compiled once per machine, in the first writable place.

Compiling them all takes most of a minute. numba keeps what it compiled beside a module or in the user's
cache, refuses to import a module where it can write neither, and does not read where it cannot write: what
was compiled into an image whose root is read-only is lost to it. Here one place is chosen for all kernels,
and those that lie in the package are copied there.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import shutil
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

#: Every kernel of the package that was imported so far.
KERNELS: list[Any] = []

log = logging.getLogger(__name__)
_NAME = "csas_shadow_ros"
_lock = threading.Lock()


@dataclass(frozen=True)
class Place:
    """Where kernels are kept.

    Parameters
    ----------
    kind : str
        ``NUMBA_CACHE_DIR``, ``package``, ``user cache``, ``temporary folder`` or ``nowhere``.
    folder : Path or None
        None where nothing can be written: every process compiles for itself.
    """

    kind: str
    folder: Path | None

    def __str__(self) -> str:
        return self.kind if self.folder is None else f"{self.folder} ({self.kind})"


def package_folder() -> Path:
    """Return the kernels' folder inside the package, used if it is writable."""
    return Path(__file__).resolve().parents[1] / "__pycache__" / "kernels"


def _places() -> Iterator[Place]:
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        yield Place("NUMBA_CACHE_DIR", Path(given).absolute())
    yield Place("package", package_folder())
    # A user without an entry in passwd has no home: "~" then stays what it is.
    home = os.path.expanduser("~/.cache")  # noqa: PTH111  (Path's raises)
    for base in (os.environ.get("XDG_CACHE_HOME", ""), home):
        if Path(base).is_absolute():
            yield Place("user cache", Path(base) / _NAME / "kernels")
    with contextlib.suppress(OSError):  # there is no folder for temporary files
        yield Place("temporary folder", Path(tempfile.gettempdir()) / f"{_NAME}-{os.geteuid()}")


def _usable(place: Place) -> bool:
    """Make a place's folder, and tell whether it is ours alone and can be written."""
    folder = place.folder
    assert folder is not None
    try:
        if place.kind == "temporary folder":
            # Its name can be guessed, and what lies in it will be executed.
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
            if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o022:
                return False
        else:
            folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _bring(source: Path, target: Path) -> None:
    """Copy kernels that are missing or older in another place, each index after what it names."""
    with contextlib.suppress(OSError):  # they are compiled then
        for index in source.glob("*/*.nbi"):
            there = target / index.relative_to(source)
            if there.exists() and there.stat().st_mtime >= index.stat().st_mtime:
                continue
            there.parent.mkdir(exist_ok=True)
            for file in (*index.parent.glob(f"{index.stem}.*.nbc"), index):
                # Another process may be reading, or doing the same.
                part = there.with_name(f"{file.name}.{os.getpid()}")
                shutil.copy2(file, part)
                part.replace(there.with_name(file.name))


@functools.cache
def place() -> Place:
    """Choose the kernels' folder: NUMBA_CACHE_DIR, package, user cache or temporary folder.

    A place other than the first two is said when it is made; that there is none, by every process.

    Examples
    --------
    >>> from csas_shadow_ros.core.kernels import place
    >>> place().kind in ("NUMBA_CACHE_DIR", "package", "user cache", "temporary folder", "nowhere")
    True
    """
    for candidate in _places():
        folder = candidate.folder
        assert folder is not None
        known = folder.exists()
        if not _usable(candidate):
            continue
        if candidate.kind in ("user cache", "temporary folder"):
            if not known:
                log.warning("keeping compiled kernels in %s: %s is not writable", folder, package_folder())
            _bring(package_folder(), folder)
        return candidate
    log.warning(
        "cannot keep compiled kernels: no folder is writable; expected one of package, user cache "
        "and temporary folder, or NUMBA_CACHE_DIR"
    )
    return Place("nowhere", None)


@contextlib.contextmanager
def _numba_keeps_in(folder: Path) -> Iterator[None]:
    """Set numba's variable, which goes before its own choice, for the moment."""
    config: Any = numba.config
    usual, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        yield
    finally:
        config.CACHE_DIR = usual


def kernel(**options: Any) -> Callable[[Function], Function]:
    """Compile a function at its first call, without the interpreter lock, and cache it.

    Parameters
    ----------
    **options
        Of ``numba.njit``.

    Returns
    -------
    callable
        Decorator of the function.
    """

    def compiled(function: Function) -> Function:
        folder = place().folder
        if folder is None:
            made: Any = numba.njit(nogil=True, **options)(function)
        else:
            with _lock, _numba_keeps_in(folder):
                made = numba.njit(nogil=True, cache=True, **options)(function)
        KERNELS.append(made)
        return made  # type: ignore[no-any-return]

    return compiled


def counts() -> tuple[int, int]:
    """Count the kernels that this process loaded and compiled, variants included."""
    stats = [k.stats for k in KERNELS]
    loaded = sum(sum(s.cache_hits.values()) for s in stats)
    return loaded, sum(sum(s.cache_misses.values()) for s in stats)
