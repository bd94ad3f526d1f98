"""A batch: bags in, an archive out. One bag is one task; it ends in a row, whatever becomes of it."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, get_args

from .. import __version__
from ..core.errors import ParameterError
from .catalogue import Catalogue, failed_line
from .layout import Archive
from .sources import bags_of, signature_of
from .task import Options, Redo, Reply, Task, give_up, peak_mb, process
from .workers import WorkerDiedError, Workers

#: How often (s) is looked whether somebody wants an end, or rows have waited for long.
_LOOK_S = 0.5
#: How often (s) a line says how far it is, where there is no bar.
_LINE_S = 30.0


@dataclass
class Summary:
    """What a batch did.

    Parameters
    ----------
    bags : int
        That were meant.
    processed : int
        Tasks that were done now; those that failed among them.
    failed : int
        Bags of which a run has no result, now or before.
    known : int
        Bags that needed nothing.
    changed : int
        Of those, bags whose content, parameters or version are others than their result's.
    runs : int
        In the catalogue, all told.
    seconds : float
        Wall time.
    interrupted : bool
        Whether it was told to end before all was done.
    memory_mb : float
        Most that this process took; its workers have their own bound.
    """

    bags: int = 0
    processed: int = 0
    failed: int = 0
    known: int = 0
    changed: int = 0
    runs: int = 0
    seconds: float = 0.0
    interrupted: bool = False
    memory_mb: float = 0.0

    def __str__(self) -> str:
        parts = [f"{self.processed} of {self.bags} bags processed in {_span(self.seconds)}"]
        if self.known:
            parts.append(f"{self.known} already done")
        if self.failed:
            parts.append(f"{self.failed} failed")
        text = "; ".join(parts)
        if self.changed:
            text += f"\n{self.changed} of them of other content, parameters or version: --redo changed"
        return text


@dataclass
class _Course:
    """How far a batch is, told as it goes."""

    total: int
    quiet: bool
    notice: Callable[[str], None]
    done: int = 0
    worked: int = 0
    failed: int = 0
    began: float = field(default_factory=time.monotonic)
    _last: float = field(default_factory=time.monotonic)
    _bar: Any = None

    def __enter__(self) -> _Course:
        if not self.quiet and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=self.total, unit="bag", file=sys.stderr, leave=False, smoothing=0.05)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def move(self, *, worked: bool, failed: bool) -> None:
        self.done += 1
        self.worked += worked
        self.failed += failed
        if self._bar is not None:
            self._bar.set_postfix(failed=self.failed, refresh=False)
            self._bar.update()
        elif time.monotonic() - self._last > _LINE_S:
            self._last = time.monotonic()
            self.notice(str(self))

    def __str__(self) -> str:
        seconds = max(time.monotonic() - self.began, 1e-9)
        rate = self.done / seconds
        left = (self.total - self.done) / rate if self.done else float("nan")
        per = f"{rate:.2f} bags/s" if rate >= 1 else f"{60 * rate:.1f} bags/min"
        return f"{self.done} of {self.total}, {self.failed} failed, {per}, {_span(left)} left"


def _span(seconds: float) -> str:
    if not seconds < 1e9:
        return "?"
    if seconds < 120:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


class _Stop:
    """Ctrl-C: once, no further bag is begun; twice, those that are being processed are left."""

    def __init__(self, notice: Callable[[str], None]) -> None:
        self.times = 0
        self._notice = notice

    @contextlib.contextmanager
    def heard(self) -> Iterator[_Stop]:
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = signal.signal(signal.SIGINT, self._hear)
        try:
            yield self
        finally:
            signal.signal(signal.SIGINT, before)

    def _hear(self, _: int, __: FrameType | None) -> None:
        self.times += 1


def run_batch(
    sources: Iterable[str | Path],
    out: str | Path,
    make_workers: Callable[[], Workers],
    options: Options | None = None,
    *,
    redo: Iterable[Redo] = (),
    durable: bool = True,
    quiet: bool = True,
    notice: Callable[[str], None] = lambda _: None,
) -> Summary:
    """Process many bags into an archive.

    What is there already is left as it is: the same call goes on after anything that ended the one before.

    Parameters
    ----------
    sources : iterable of path-like
        See `bags_of`.
    out : path-like
        The archive, which is made if it is not there.
    make_workers : callable
        Gives the workers; called when it is known that the archive can be written.
    options : Options, optional
        What is done with each bag.
    redo : iterable of str
        ``failed``: bags whose row says so. ``changed``: those whose content, parameters or version are others
        than their result's. ``all``.
    durable : bool
        Write results out to the disk before they are in place.
    quiet : bool
        No progress bar.
    notice : callable
        Called with each line that a user should see.

    Returns
    -------
    Summary
        What was done.

    Raises
    ------
    CsasError
        If nothing can be processed at all; a bag that cannot be is a row.

    Examples
    --------
    >>> from csas_shadow_ros.archive.batch import run_batch
    >>> from csas_shadow_ros.archive.workers import LocalWorkers
    >>> done = run_batch(["my_runs"], "season", lambda: LocalWorkers(2))  # doctest: +SKIP
    """
    chosen = frozenset(redo)
    if unknown := sorted(chosen - set(get_args(Redo))):
        raise ParameterError(f"redo is {unknown[0]!r}; expected {', '.join(get_args(Redo))}")
    began = time.monotonic()
    bags = bags_of(sources)
    archive = Archive(out)
    archive.make()
    with archive.held(), _Stop(notice).heard() as stop:
        batch = _Batch(archive, options or Options(), chosen, durable, notice)
        left = batch.left_of(bags)
        summary = batch.summary
        if left:
            workers = make_workers()
            notice(f"{len(left)} bags to look at: {workers}")
            try:
                with _Course(len(left), quiet, notice) as course:
                    batch.process(left, workers, course, stop)
            finally:
                # Also where the batch ends early, what came back is kept.
                workers.end(now=stop.times > 1 or sys.exc_info()[0] is not None)
                batch.catalogue.flush()
        summary.runs = batch.catalogue.merge()
        summary.seconds = time.monotonic() - began
        summary.interrupted = stop.times > 0
        summary.memory_mb = peak_mb()
        return summary


class _Batch:
    """The bags that are being processed, and what is known of the others."""

    def __init__(
        self,
        archive: Archive,
        options: Options,
        redo: frozenset[str],
        durable: bool,
        notice: Callable[[str], None],
    ) -> None:
        self.archive, self.options, self.redo, self.durable, self.notice = (
            archive,
            options,
            redo,
            durable,
            notice,
        )
        self.catalogue = Catalogue(archive)
        self.summary = Summary()

    def left_of(self, bags: list[Path]) -> list[Path]:
        """Return the bags that a worker has to look at: those without a row that says that all is done."""
        self.summary.bags = len(bags)
        wanted = set(map(str, bags))
        known = {row[0]: row[1:] for row in self.catalogue.known() if row[0] in wanted}
        left = []
        for bag in bags:
            row = known.get(str(bag))
            if row is None or "all" in self.redo:
                left.append(bag)
                continue
            signature, options, version, failed, _ = row
            try:
                same = signature_of(bag)[0] == signature
            except OSError:
                same = signature == ""
            same = same and (options, version) == (self.options.key, __version__)
            if (not same and "changed" in self.redo) or (failed and "failed" in self.redo):
                left.append(bag)
                continue
            self.summary.known += 1
            self.summary.changed += not same
            self.summary.failed += failed
        return left

    def process(self, bags: list[Path], workers: Workers, course: _Course, stop: _Stop) -> None:
        """Have all bags processed; a worker that dies costs its task one retry."""
        waiting: deque[tuple[Task, int]] = deque()
        running: dict[Future[Reply], tuple[Task, int]] = {}
        more = iter(bags)

        def refill() -> None:
            while len(running) < workers.window and not stop.times:
                if not waiting:
                    bag = next(more, None)
                    if bag is None:
                        return
                    waiting.append((self._task(bag, workers), 0))
                task, tried = waiting.popleft()
                running[workers.submit(process, task)] = (task, tried)

        said = False
        while True:
            refill()
            if stop.times and not said:
                said = True
                self.notice(f"ends with the {len(running)} bags that are being processed; again: at once")
            if not running or stop.times > 1:
                return
            done, _ = wait(running, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
            for future in done:
                task, tried = running.pop(future)
                try:
                    reply = workers.result(future)
                except WorkerDiedError as error:
                    if not tried or not error.at_task:
                        self.notice(f"warning: a worker died at {task.bag}: it is tried once more")
                        waiting.append((task, tried + error.at_task))
                        continue
                    reply = give_up(task, f"{error} twice: killed, or out of the machine's memory")
                self._take(reply, course)
            self.catalogue.tick()

    def _task(self, bag: Path, workers: Workers) -> Task:
        return Task(str(self.archive.root), str(bag), self.options, self.redo, workers.threads, self.durable)

    def _take(self, reply: Reply, course: _Course) -> None:
        self.catalogue.add(reply.rows)
        failures = reply.rows.failures
        self.summary.processed += reply.worked
        self.summary.known += not reply.worked
        self.summary.failed += bool(failures)
        for row in reply.rows.runs:
            if row.get("reason") in failures:
                with self.archive.failed.open("a", encoding="utf-8") as file:
                    file.write(failed_line(row["bag"], row["number"], row["reason"]))
        course.move(worked=reply.worked, failed=bool(failures))
