"""One bag, in a worker: processed unless it is done already. Only rows come back."""

from __future__ import annotations

import contextlib
import hashlib
import platform
import re
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from .. import __version__
from ..bags import BagReader
from ..bags.tracks import BagRuns
from ..core.errors import CsasError
from ..core.parameters import MAX_OBJECTS, PipelineParameters
from ..run_bag import process_bag
from .layout import Archive, PartOfTask, Record, brief, jsonable
from .rows import Rows, copy_of, rows_of
from .sources import content_of, signature_of

#: What is done again: what failed, what has changed, everything.
Redo = Literal["failed", "changed", "all"]


class WorkerError(CsasError):
    """A worker cannot do any task: another version, or it does not see the archive."""


@dataclass(frozen=True)
class Options:
    """What a batch does with each bag, whatever the bag.

    Parameters
    ----------
    parameters : PipelineParameters
        Of every stage.
    start_from, spectrum_sign, namespace, max_objects
        See `process_bag`.
    bag, figures : bool
        Whether ``result.mcap`` and ``figures/`` are written.
    """

    parameters: PipelineParameters = field(default_factory=PipelineParameters)
    start_from: str = "auto"
    spectrum_sign: int | None = None
    namespace: str | None = None
    max_objects: int = MAX_OBJECTS
    bag: bool = False
    figures: bool = False

    @property
    def key(self) -> str:
        """Hash of all of them."""
        return hashlib.sha256(jsonable(asdict(self)).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Task:
    """A bag to process.

    Parameters
    ----------
    archive, bag : str
        Absolute paths, which the worker sees too.
    options : Options
        What is done with it.
    redo : frozenset of str
        What is done although there is a result.
    threads : int
        Of the worker.
    durable : bool
        Write results out to the disk before they are in place.
    version : str
        Of the batch: a worker of another one refuses.
    """

    archive: str
    bag: str
    options: Options
    redo: frozenset[str] = frozenset()
    threads: int = 1
    durable: bool = True
    version: str = __version__


@dataclass
class Reply:
    """What comes back of a task.

    Parameters
    ----------
    bag : str
        Its bag.
    worked : bool
        Whether it was processed now: False for what was there.
    rows : Rows
        Of the catalogue.
    """

    bag: str
    worked: bool
    rows: Rows


def process(task: Task) -> Reply:
    """Process a bag, unless its result is there.

    Whatever is wrong with the bag becomes a row with its reason.

    Raises
    ------
    WorkerError
        If this worker is not fit for any task.
    """
    if task.version != __version__:
        raise WorkerError(
            f"worker on {platform.node()} has csas_shadow_ros {__version__}; expected {task.version}"
        )
    archive, bag = Archive(task.archive), Path(task.bag)
    if not archive.exists:
        raise WorkerError(
            f"worker on {platform.node()} sees no archive at {task.archive}; expected a shared folder"
        )
    record = Record(str(bag), "", "", task.options.key, __version__, host=platform.node())
    began, unreadable = time.perf_counter(), ""
    _forget_peak()
    try:
        record.signature, record.bag_bytes = signature_of(bag)
        record.content = content_of(bag)
    except (CsasError, OSError) as error:
        unreadable = _why(error)
    with archive.task_folder(bag, record.content) as folder:
        known = Record.read(folder)
        if known is not None:
            if _is_copy(known, bag):
                record.finished_us = now_us()
                return Reply(task.bag, False, copy_of(known, record))
            if _settled(known, record, task, folder):
                if (known.bag, known.signature) != (record.bag, record.signature):
                    # Moved or touched: it is found without reading it the next time.
                    known.bag, known.signature = record.bag, record.signature
                    known.finished_us = now_us()  # of two places that a bag was in, the later one counts
                    known.write(folder, durable=task.durable)
                return Reply(task.bag, False, rows_of(folder, known, archive.root))
        record.runs = [PartOfTask(reason=unreadable)] if unreadable else _process_runs(task, bag, folder)
        record.seconds = time.perf_counter() - began
        record.peak_memory_mb = peak_mb()
        return _finish(record, folder, archive, durable=task.durable)


def give_up(task: Task, reason: str) -> Reply:
    """Leave the record of a task that no worker lived to end."""
    archive, bag = Archive(task.archive), Path(task.bag)
    record = Record(str(bag), "", "", task.options.key, task.version, host=platform.node())
    with contextlib.suppress(OSError):
        record.signature, record.bag_bytes = signature_of(bag)
    record.runs = [PartOfTask(reason=reason)]
    with archive.task_folder(bag, "") as folder:
        return _finish(record, folder, archive, durable=task.durable)


def _finish(record: Record, folder: Path, archive: Archive, *, durable: bool) -> Reply:
    record.finished_us = now_us()
    record.write(folder, durable=durable)
    return Reply(record.bag, True, rows_of(folder, record, archive.root))


def now_us() -> int:
    """Return the time as records have it."""
    return time.time_ns() // 1000


def _why(error: BaseException) -> str:
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else brief(error)
    return brief(error)


def _is_copy(known: Record, bag: Path) -> bool:
    """Whether what is known is of another bag, which is still there and as it was."""
    if known.bag == str(bag) or not known.content:
        return False
    try:
        return signature_of(Path(known.bag))[0] == known.signature
    except OSError:
        return False


def _settled(known: Record, now: Record, task: Task, folder: Path) -> bool:
    """Whether what is there is what is asked for, or not to be done again."""
    if "all" in task.redo:
        return False
    same = (known.content, known.options, known.version) == (now.content, now.options, now.version)
    if not now.content:
        same = same and known.signature == now.signature
    if not same and "changed" in task.redo:
        return False
    if known.failed and "failed" in task.redo:
        return False
    return all(part.reason or (folder / part.folder).is_dir() for part in known.runs)


def _process_runs(task: Task, bag: Path, folder: Path) -> list[PartOfTask]:
    _use_threads(task.threads)
    try:
        names = BagRuns(BagReader(bag, task.options.namespace), lambda _: None).names
    except Exception as error:  # whatever is wrong with it is its row's reason
        return [PartOfTask(reason=_why(error))]
    if len(names) < 2:
        return [_process_run(task, bag, folder, PartOfTask(), None)]
    return [
        _process_run(task, bag, folder, PartOfTask(number, f"run_{number}"), number)
        for number in range(1, len(names) + 1)
    ]


def _process_run(task: Task, bag: Path, folder: Path, part: PartOfTask, number: int | None) -> PartOfTask:
    o = task.options
    try:
        process_bag(
            bag,
            folder / part.folder,
            o.parameters,
            start_from=o.start_from,
            spectrum_sign=o.spectrum_sign,
            namespace=o.namespace,
            run_of_bag=number,
            overwrite=True,
            write_bag=o.bag,
            figures=o.figures,
            durable=task.durable,
            workers=task.threads,
            max_objects=o.max_objects,
            command=("csas-shadow", "batch", str(bag), "--out", task.archive),
        )
    except Exception as error:  # MemoryError too: the bound of this worker
        part.reason = (
            _why(error)
            if not isinstance(error, MemoryError)
            else "it needs more memory than a worker may take"
        )
    return part


def _use_threads(count: int) -> None:
    """Hold OpenCV to a number of threads; BLAS and numba are told by the environment."""
    import cv2

    cv2.setNumThreads(count)


def _forget_peak() -> None:
    """Have the kernel begin anew with this process's peak of memory, where it can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_mb() -> float:
    """Return this program's peak of memory; `getrusage` would begin with that of whoever started it."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        return 0.0
    return int(found[1]) / 1000.0 if found else 0.0
