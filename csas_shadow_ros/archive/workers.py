"""Workers of a batch: processes of this machine or of a cluster, as executors of `concurrent.futures`."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

from ..core.errors import CsasError, ParameterError
from ..graph.processes import THREADS_OF_LIBRARIES, environment_of
from .extras import need

T = TypeVar("T")

#: Of the machine's memory, what the workers may take together: the system and the page cache need the rest.
_SHARE = 0.8
#: A worker that processes the smallest image takes so much (bytes); less is a slip.
_LEAST_MEMORY = 500_000_000
#: One that is killed as it starts is started again; so many in a row will not come up.
_MOST_STARTS = 3
#: How often (s) a cluster is asked for its workers.
_ASK_S = 2.0
#: A scheduler that does not answer in so many seconds is not there.
_PATIENCE_S = 20.0


class WorkersError(CsasError):
    """There are no workers, or they are gone."""


class WorkerDiedError(CsasError):
    """The process that did a task is gone.

    Parameters
    ----------
    text : str
        What happened.
    at_task : bool
        Whether the task may be the cause: not where the process had not even started.
    """

    def __init__(self, text: str, *, at_task: bool = True) -> None:
        super().__init__(text)
        self.at_task = at_task


class Workers(Protocol):
    """What a batch needs of its workers."""

    #: Threads of each.
    threads: int

    @property
    def window(self) -> int:
        """Tasks that are given out at once."""
        ...

    def submit(self, function: Callable[..., T], /, *arguments: Any) -> Future[T]:
        """Have a function called in a worker."""
        ...

    def result(self, future: Future[T]) -> T:
        """Return what came of it.

        Raises
        ------
        WorkerDiedError
            If its worker is gone; the others are not.
        WorkersError
            If all are.
        """
        ...

    def end(self, *, now: bool) -> None:
        """End the workers: when they have done what they do, or now."""
        ...


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes() -> int:
    """Return the memory of this machine or, if that is less, of the control group that this process is in."""
    found = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):
            found.append(int(Path(name).read_text()))
    return min(found)


def _begin(memory: int, _: int) -> None:
    """Prepare a worker: bounded memory, no Ctrl-C of its own, and an end when the batch is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the batch decides what becomes of the tasks
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    bound = memory if most == resource.RLIM_INFINITY else min(memory, most)
    resource.setrlimit(resource.RLIMIT_DATA, (bound, most))
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)  # killed: nobody would take what this one has to give

    threading.Thread(target=follow, daemon=True).start()


class _Slot:
    """One process, made anew when it has died."""

    def __init__(self, begin: tuple[int, int]) -> None:
        self._begin = begin
        self._pool: ProcessPoolExecutor | None = None
        #: Its number, once it has started.
        self.process: Future[int] | None = None

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        if self._pool is not None:
            try:
                return self._pool.submit(function, *arguments)
            except BrokenProcessPool:
                self.end(now=False)
        # Spawned, not forked: threads of libraries do not outlive a fork. What a library reads when it is
        # loaded has to be set before.
        context = multiprocessing.get_context("spawn")
        names = dict.fromkeys(THREADS_OF_LIBRARIES, str(self._begin[1]))
        with environment_of(names):
            self._pool = ProcessPoolExecutor(1, context, initializer=_begin, initargs=self._begin)
            self.process = self._pool.submit(os.getpid)
        return self._pool.submit(function, *arguments)

    def end(self, *, now: bool) -> None:
        if self._pool is None:
            return
        process = self.process
        if now and process is not None and process.done() and process.exception() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.result(), signal.SIGKILL)
        self._pool.shutdown(wait=not now, cancel_futures=True)
        self._pool = None


class LocalWorkers(Executor):
    """Processes of this machine, each with an executor of its own: one that dies takes no other with it.

    Parameters
    ----------
    count : int
        Processes.
    threads : int, optional
        Of each; by default the processors are shared.
    memory_gb : float, optional
        What each may take; by default the machine's memory is shared, but for a fifth of it.

    Raises
    ------
    ParameterError
        If one is out of range.
    """

    def __init__(self, count: int, threads: int | None = None, memory_gb: float | None = None) -> None:
        if not 1 <= count <= 1024:
            raise ParameterError(f"workers is {count}; expected 1 to 1024")
        if threads is not None and not 1 <= threads <= 1024:
            raise ParameterError(f"threads is {threads}; expected 1 to 1024")
        self._count = count
        self.threads = threads or max(1, processors() // count)
        share = _SHARE * memory_bytes() / count
        self.memory = int(share if memory_gb is None else memory_gb * 1e9)
        if self.memory < _LEAST_MEMORY:
            raise ParameterError(
                f"a worker's memory is {self.memory / 1e9:.2f} GB; expected {_LEAST_MEMORY / 1e9:g} or more"
            )
        self._idle: SimpleQueue[_Slot] = SimpleQueue()
        self._process_of: dict[Future[Any], Future[int] | None] = {}
        self._never_started = 0
        self._slots = [_Slot((self.memory, self.threads)) for _ in range(count)]
        for slot in self._slots:
            self._idle.put(slot)

    @property
    def window(self) -> int:
        """Tasks that are given out at once: one a process."""
        return self._count

    def __str__(self) -> str:
        each = "thread" if self.threads == 1 else "threads"
        processes = "worker" if self.window == 1 else "workers"
        return f"{self.window} {processes} of {self.threads} {each} and {self.memory / 1e9:.1f} GB at most"

    def submit(self, function: Callable[..., T], /, *arguments: Any, **_: Any) -> Future[T]:
        """Have a function called in a process that does nothing; waits until there is one."""
        slot = self._idle.get()
        try:
            future = slot.submit(function, *arguments)
        except BaseException:
            self._idle.put(slot)
            raise
        self._process_of[future] = slot.process
        future.add_done_callback(lambda _: self._idle.put(slot))
        return future

    def result(self, future: Future[T]) -> T:
        """Return what came of a task; see `Workers.result`."""
        process = self._process_of.pop(future, None)
        try:
            value = future.result()
        except BrokenProcessPool as error:
            if process is not None and process.done() and process.exception() is None:
                raise WorkerDiedError("its worker died") from error
            self._never_started += 1
            if self._never_started >= _MOST_STARTS:
                raise WorkersError(f"{_MOST_STARTS} workers in a row died before they had started") from error
            raise WorkerDiedError("its worker did not start", at_task=False) from error
        self._never_started = 0
        return value

    def end(self, *, now: bool) -> None:
        """End the processes."""
        for slot in self._slots:
            slot.end(now=now)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: ARG002
        """End the processes, as `concurrent.futures` has it."""
        self.end(now=not wait)


class ClusterWorkers:
    """Workers of a dask.distributed cluster that is there already, by ``Client.get_executor``.

    Parameters
    ----------
    address : str, optional
        Of the scheduler, ``tcp://host:port``.
    scheduler_file : path-like, optional
        What the scheduler wrote.
    threads : int
        Of each task: the cluster says how many tasks a worker does at once.

    Raises
    ------
    MissingExtraError
        If distributed is not installed.
    WorkersError
        If the scheduler does not answer.
    """

    def __init__(
        self, address: str | None = None, scheduler_file: str | None = None, threads: int = 1
    ) -> None:
        self._library = need("distributed", "--scheduler", "cluster")
        self.threads, self._where = threads, address or scheduler_file
        try:
            self._client = self._library.Client(
                address, scheduler_file=scheduler_file, timeout=_PATIENCE_S, set_as_default=False
            )
        except (OSError, ValueError, TimeoutError) as error:
            raise WorkersError(
                f"scheduler {self._where} does not answer ({' '.join(str(error).split())[:120]})"
            ) from error
        self._pool = self._client.get_executor(pure=False)
        self._window, self._asked = 2, 0.0
        with contextlib.suppress(TimeoutError):  # a cluster may begin them when there is something to do
            self._client.wait_for_workers(1, timeout=_PATIENCE_S)

    @property
    def window(self) -> int:
        """Tasks that are given out at once: two a thread, so that none waits for the next; it may grow."""
        if time.monotonic() - self._asked > _ASK_S:
            with contextlib.suppress(Exception):  # that it is gone is told by the tasks
                self._window = 2 * max(1, sum(self._client.nthreads().values()))
            self._asked = time.monotonic()
        return self._window

    def __str__(self) -> str:
        workers = self._client.nthreads()
        return f"{len(workers)} workers of {self._where}, {sum(workers.values())} tasks at once"

    def submit(self, function: Callable[..., T], /, *arguments: Any) -> Future[T]:
        """Have a function called in a worker of the cluster."""
        try:
            future: Future[T] = self._pool.submit(function, *arguments)
        except Exception as error:
            raise self._gone() from error
        return future

    def result(self, future: Future[T]) -> T:
        """Return what came of a task; see `Workers.result`."""
        if future.cancelled():
            raise self._gone()
        error = future.exception()
        if error is not None and self._client.status != "running":
            raise self._gone() from error
        if isinstance(error, self._library.KilledWorker):
            raise WorkerDiedError("its worker died, and so did others that took it over") from error
        return future.result()

    def _gone(self) -> WorkersError:
        return WorkersError(
            f"scheduler {self._where} is gone; finished bags are kept, the same command resumes"
        )

    def end(self, *, now: bool) -> None:  # noqa: ARG002  (as the local one has it)
        """Leave the cluster; it goes on without us."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=2.0)
