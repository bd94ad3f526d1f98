"""What lies where in an archive, and what a task leaves beside its results."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..core.errors import CsasError
from ..durable import sync
from ..results.layout import looks_like_results

FORMAT = "csas_shadow_ros archive 1"
TASK_FORMAT = "csas_shadow_ros task 1"
ARCHIVE, RUNS, CATALOGUE, PARTS, FAILED = "archive.json", "runs", "catalogue", ".parts", "failed.txt"
TASK, RESULTS, LOCK = "task.json", "results", ".lock"
#: Hexadecimal digits of a bag's hash in its folder's name: of 100 000 bags two alike in 64 bits are one case
#: in three billion, and the whole hash is in the record.
_DIGITS = 16
#: A folder name leaves so much of 255 bytes to the bag's name.
_MOST_NAME = 120
DONE, FAILED_STATUS, COPY = "done", "failed", "copy"


class ArchiveError(CsasError):
    """An archive cannot be made, read or written."""


@dataclass
class PartOfTask:
    """One run of a bag, and what became of it.

    Parameters
    ----------
    number : int
        Which run of the bag, from 1.
    folder : str
        Its results, relative to the record.
    reason : str
        Why there are none; empty where there are.
    """

    number: int = 1
    folder: str = RESULTS
    reason: str = ""


@dataclass
class Record:
    """What a task was asked for and how it ended: ``task.json``, the identity of what lies beside it.

    Parameters
    ----------
    bag : str
        Path of the bag.
    content : str
        SHA-256 of what the bag holds; empty where it could not be read.
    signature : str
        Hash of its files' names, sizes and times: what tells, without reading it, that it is the same.
    options : str
        Hash of parameters and options.
    version : str
        Of this package.
    finished_us : int
        When the task ended, or its bag was found in another place: microseconds since 1970 (UTC).
    runs : list of PartOfTask
        Its runs.
    bag_bytes : int
        Size of the bag.
    seconds, peak_memory_mb : float
        What it took.
    host : str
        Where it ran.
    """

    bag: str
    content: str
    signature: str
    options: str
    version: str
    finished_us: int = 0
    runs: list[PartOfTask] = field(default_factory=list)
    bag_bytes: int = 0
    seconds: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""

    @property
    def failed(self) -> bool:
        """Whether any run of the bag has no result."""
        return any(part.reason for part in self.runs)

    @classmethod
    def read(cls, folder: Path) -> Record | None:
        """Read the record of a folder; None if there is none, or none that can be read."""
        try:
            document = json.loads((folder / TASK).read_text(encoding="utf-8"))
            if document.pop("format") != TASK_FORMAT:
                return None
            document["runs"] = [PartOfTask(**part) for part in document["runs"]]
            return cls(**document)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def write(self, folder: Path, *, durable: bool) -> None:
        """Put the record in its folder, in one step, after what it speaks of."""
        text = json.dumps({"format": TASK_FORMAT, **dataclasses.asdict(self)}, indent=1)
        replace_text(folder / TASK, text, durable=durable)


def replace_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Write a file anew, in one step."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    part.write_text(text, encoding="utf-8")
    if durable:
        sync(part)
    part.replace(path)
    if durable:
        sync(path.parent)


class Archive:
    """A folder of results of many bags.

    Parameters
    ----------
    root : path-like
        The folder.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(os.path.abspath(root))  # noqa: PTH100  (a link stays one)
        self.catalogue = self.root / CATALOGUE
        self.parts = self.root / PARTS
        self.failed = self.root / FAILED

    @property
    def exists(self) -> bool:
        """Whether there is an archive of this format."""
        try:
            return bool(json.loads((self.root / ARCHIVE).read_text(encoding="utf-8"))["format"] == FORMAT)
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def make(self) -> None:
        """Make the archive, if it is not there.

        Raises
        ------
        ArchiveError
            If something else is.
        """
        if self.exists:
            return
        try:
            if self.root.exists() and (not self.root.is_dir() or any(self.root.iterdir())):
                raise ArchiveError(f"{self.root} exists and is not an archive; expected a new folder")
            (self.root / RUNS).mkdir(parents=True, exist_ok=True)
            replace_text(self.root / ARCHIVE, json.dumps({"format": FORMAT}) + "\n")
        except OSError as error:
            raise ArchiveError(f"cannot make {self.root}: {error.strerror or error}") from error

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Be the only one that writes the catalogue.

        Raises
        ------
        ArchiveError
            If somebody else is.
        """
        lock = self.root / LOCK
        lock.touch()
        with _locked(lock) as mine:
            if not mine:
                raise ArchiveError(f"{self.root} is being written by another batch; expected one at a time")
            yield

    def key_of(self, bag: Path, content: str) -> str:
        """Return what a bag's results are called by: what it holds, or its path where that is not known."""
        return content[:_DIGITS] or "x" + hashlib.sha256(os.fsencode(bag)).hexdigest()[: _DIGITS - 1]

    @contextlib.contextmanager
    def task_folder(self, bag: Path, content: str) -> Iterator[Path]:
        """Give the folder of a bag's results, to one process at a time.

        What another bag of the same content left, under another name, is the folder of this one too.
        """
        key = self.key_of(bag, content)
        shelf = self.root / RUNS / key[:2]
        shelf.mkdir(parents=True, exist_ok=True)
        with _alone(shelf / f".{key}.lock"):
            for folder in sorted(shelf.glob(f"*-{key}")):
                known = Record.read(folder)
                if known is not None and known.content == content:
                    yield folder
                    return
            name = "".join(c if c.isalnum() or c in "._-" else "_" for c in bag.name).lstrip(".")
            while len(os.fsencode(name)) > _MOST_NAME:
                name = name[:-1]
            folder = shelf / f"{name}-{key}"
            folder.mkdir(exist_ok=True)
            yield folder


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold a file that is there as long as it is held; who comes second waits."""
    while True:
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        with contextlib.suppress(OSError):  # file systems without locks
            fcntl.flock(number, fcntl.LOCK_EX)
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_ino == os.fstat(number).st_ino:
                break
        os.close(number)  # who held it has removed it
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(number)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Lock a file; give False if another holds it. It ends with the process that took it."""
    number = os.open(path, os.O_RDWR | os.O_CLOEXEC)  # NFS locks what can be written
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError:  # file systems without locks
            pass
        yield True
    finally:
        os.close(number)


def is_archive(path: str | Path) -> bool:
    """Say whether a folder is an archive."""
    return Archive(path).exists


def walk(root: Path) -> Iterator[tuple[Path, Record | None]]:
    """Iterate the folders of tasks below a folder, and results folders that no task made (record None)."""
    try:
        inside = sorted(os.scandir(root), key=lambda entry: entry.name)
    except OSError:
        return
    for entry in inside:
        if entry.name.startswith(".") or not entry.is_dir(follow_symlinks=False):
            continue
        folder = Path(entry.path)
        if (record := Record.read(folder)) is not None:
            yield folder, record
        elif looks_like_results(folder):
            yield folder, None
        else:
            yield from walk(folder)


def brief(error: BaseException) -> str:
    """Return an error as one line that fits a table."""
    text = " ".join(str(error).split())
    if not isinstance(error, CsasError | OSError):
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return text if len(text) <= 300 else text[:297] + "..."


def jsonable(value: Any) -> str:
    """Return a value's one JSON text, of which a hash is taken."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
