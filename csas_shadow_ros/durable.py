"""Folders that outlive a kill and a power cut: written out, put in place in one step, with checksums."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

#: The list of a folder's files, as ``sha256sum -c`` reads it.
CHECKSUMS = "SHA256SUMS"
#: What people add to a folder later (`viewer.desk`): it has no checksum, and may change.
BY_HAND = ("desk.json", ".desk.json.new")
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
#: File systems and kernels without an exchange say one of these.
_NO_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.EPERM, errno.ENOTSUP}
_BLOCK = 1 << 20


def sync(path: Path) -> None:
    """Write a file, or a folder's list of files, out to the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that have nothing to write out
            raise
    finally:
        os.close(number)


def sync_tree(folder: Path) -> None:
    """Write a folder, all that is in it, and its own name out to the disk."""
    for path in [*folder.rglob("*"), folder, folder.parent]:
        if not path.is_symlink() and (path.is_file() or path.is_dir()):
            sync(path)


def write_whole(path: Path, data: bytes) -> None:
    """Put a file in place in one step: whoever is killed at any moment leaves the old one or the new.

    One writer at a time: what is written first is called ``.NAME.new``, and taken over if it was left.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as place:
    ...     write_whole(Path(place) / "note.txt", b"new")
    ...     [(p.name, p.read_bytes()) for p in Path(place).iterdir()]
    [('note.txt', b'new')]
    """
    new = path.with_name(f".{path.name}.new")
    with new.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    sync(path.parent)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes that ask for it away from a folder; where there are no locks, nobody is kept."""
    number = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a network's file system may have none
            fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


def exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; False where the system cannot."""
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):  # no glibc of 2018 or later
        return False
    if function(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(one), None, str(other))


def sha256(path: Path) -> str:
    """Return a file's SHA-256 in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def write_checksums(folder: Path, known: dict[str, str]) -> None:
    """Write the SHA-256 of every file of a folder into it.

    Parameters
    ----------
    folder : Path
        Holds files that do not change any more.
    known : dict
        Sums by name, which are not made again; takes those that are.
    """
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    lines = []
    for name in names:
        if name != CHECKSUMS and name not in BY_HAND:
            known[name] = known.get(name) or sha256(folder / name)
            lines.append(f"{known[name]}  {name}\n")
    (folder / CHECKSUMS).write_text("".join(lines), encoding="utf-8")


class Place:
    """A folder that is made beside its final place and put there whole.

    While it is made it is called ``.NAME.incomplete-PID`` and locked; what it replaces is called
    ``.NAME.replaced-PID`` for a moment where the system cannot exchange two folders.

    Parameters
    ----------
    folder : Path
        The final place.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.work = folder.with_name(f".{folder.name}.incomplete-{os.getpid()}")
        self._lock: int | None = None
        self._made: tuple[int, int] | None = None

    def is_ours(self) -> bool:
        """Say whether what is in place is what was put there by this."""
        try:
            found = self.folder.stat()
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._made

    def clear(self, tell: Callable[[str], None]) -> None:
        """Remove what killed processes left here; bring back what one of them was replacing.

        Parameters
        ----------
        tell : callable
            Called with a line for each.
        """
        for path, kind in list(self._left()):
            if kind == "replaced" and not self.folder.exists():
                path.rename(self.folder)
                tell(f"brought {self.folder} back: a run was killed while it replaced it")
                continue
            shutil.rmtree(path, ignore_errors=True)
            if path.exists():
                tell(f"cannot remove {path}, which a killed run left")
            else:
                tell(f"removed {path}, which a killed run left")

    def _left(self) -> Iterator[tuple[Path, str]]:
        pattern = re.compile(rf"\.{re.escape(self.folder.name)}\.(incomplete|replaced)-(\d{{1,18}})(\.\d+)?")
        try:
            found = sorted(self.folder.parent.iterdir())
        except OSError:
            return
        for path in found:
            match = pattern.fullmatch(path.name)
            if match and path.is_dir() and not path.is_symlink() and _abandoned(path, int(match[2])):
                yield path, match[1]

    def make(self) -> Path:
        """Make the working folder, empty, and lock it; a further one of this process is numbered."""
        self.release()
        first, number = f".{self.folder.name}.incomplete-{os.getpid()}", 1
        self.work = self.folder.with_name(first)
        while self.work.exists():
            if not _locked(self.work):
                shutil.rmtree(self.work)
                continue
            number += 1
            self.work = self.folder.with_name(f"{first}.{number}")
        self.work.mkdir(parents=True)
        self._lock = os.open(self.work, os.O_RDONLY)
        with contextlib.suppress(OSError):  # file systems without locks: the process's number has to do
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return self.work

    def put(self, *, replace: bool, durable: bool) -> None:
        """Put the working folder in its place.

        Parameters
        ----------
        replace : bool
            What is there goes; otherwise only an empty folder does.
        durable : bool
            Write everything out to the disk before and after.

        Raises
        ------
        OSError
            If the disk refuses, or the place is taken.
        """
        old = self.work.with_name(self.work.name.replace(".incomplete-", ".replaced-"))
        if durable:
            sync_tree(self.work)
        if not replace or not self.folder.exists():
            self.work.rename(self.folder)  # which an empty folder allows, and no other
        elif not exchange(self.work, self.folder):
            self.folder.rename(old)
            self.work.rename(self.folder)
        found = self.folder.stat()
        self._made = (found.st_dev, found.st_ino)
        if durable:
            sync(self.folder.parent)
        for left in (self.work, old):
            shutil.rmtree(left, ignore_errors=True)
        self.release()

    def copy_back(self, *without: str) -> Path:
        """Make a working folder that holds what is in place, but for some files: links, or else copies.

        A file that is to be written anew must not be a link: both would change.
        """
        work = self.make()
        for path in sorted(self.folder.rglob("*")):
            copy = work / path.relative_to(self.folder)
            if path.relative_to(self.folder).as_posix() in without:
                continue
            if path.is_dir():
                copy.mkdir()
                continue
            try:
                os.link(path, copy)
            except OSError:
                shutil.copy2(path, copy)
        return work

    def release(self) -> None:
        """Let go of the lock."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def abandon(self) -> None:
        """Remove the working folder."""
        shutil.rmtree(self.work, ignore_errors=True)
        self.release()


def _abandoned(path: Path, pid: int) -> bool:
    """Say whether the process that made a folder is dead.

    A process of that number may be another one; and one that is not to be seen may live in another
    container: that one holds the lock.
    """
    try:
        os.kill(pid, 0)
        return False
    except (ProcessLookupError, OverflowError):
        pass
    except PermissionError:
        return False
    return not _locked(path)


def _locked(path: Path) -> bool:
    """Say whether a folder is locked; where there are no locks, or it is gone, it is not."""
    try:
        number = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(number)
    return False
