"""The processes of a node graph: starts, watches, restarts and ends them by their ids."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future
from pathlib import Path
from types import FrameType, TracebackType
from typing import IO, Any

from msg_adapters.progress import GRAPH_ID

from ..core.errors import CsasError
from ..node_table import NODES
from ..nodes.runtime.params import check, yaml_text
from ..nodes.runtime.shared_memory import (
    LOCKED_S,
    LONG_LOCKED_S,
    bound,
    free_shared_memory,
    ports_of,
    remove_ports,
    remove_strays,
    unused,
)
from ..nodes.runtime.watchdog import STANDS_STILL_S, says_that_it_stood_still

PACKAGE = "csas_shadow_ros"
#: The ports of higher domains do not exist.
MAX_DOMAIN_ID = 232
#: Of a domain's ports 0 and 1 are its multicast ones, and 10 and up its participants': this one is nobody's.
_HELD = 9
_START_ORDER = tuple(NODES)
#: Each process has its own numerical libraries: as many threads in each as there are cores would only wait.
THREADS_OF_LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: What a node that is started again is told besides: the recording is there, and to be gone on with.
_AGAIN = {"bag_recorder": "resume:=true"}
#: A fork server that is told to end gets so long, and one that is asked for a node so long: what it loads may
#: have to be compiled first.
_GRACE_S, _PATIENCE_S = 5.0, 120.0
#: With less shared memory than the segments of a graph may come to fill, a write into them is a bus error:
#: then the middleware's own, smaller ones do, more slowly.
_SHARED_MEMORY = 1 << 30

#: Views are a few MB: by default glibc gives such memory back at once, and a quarter of the nodes' time went
#: into getting it again, page by page.
_MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(1 << 26), "MALLOC_TRIM_THRESHOLD_": str(1 << 28)}


class ReplayError(CsasError):
    """The graph could not finish a replay."""


def config_file(name: str) -> Path:
    """Find a file of ``config/``: in the source tree, or where the package was installed.

    Raises
    ------
    ReplayError
        If it is nowhere.
    """
    here = Path(__file__).resolve()
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    places = [here.parents[2] / "config" / name]
    places += [Path(prefix) / "share" / PACKAGE / "config" / name for prefix in prefixes if prefix]
    for place in places:
        if place.is_file():
            return place
    raise ReplayError(f"{name} not found; expected it at one of: {', '.join(map(str, places))}")


class DomainReservation:
    """A ROS domain reserved on this machine until it is closed or its process ends.

    What holds it is a UDP port of the domain that no participant uses: whoever shares the participants' ports
    shares it too, users and containers alike, and it is free again whatever ends the process.

    Parameters
    ----------
    domain_id : int, optional
        The domain to reserve; one of which no port is in use otherwise.

    Raises
    ------
    ReplayError
        If it is reserved already, or all domains are in use.

    Examples
    --------
    >>> with DomainReservation() as domain_id:
    ...     1 <= domain_id <= 101
    True
    """

    def __init__(self, domain_id: int | None = None) -> None:
        if domain_id is not None:
            held = bound(ports_of(domain_id)[0] + _HELD)
            if held is None:
                raise ReplayError(
                    f"ROS domain {domain_id} is held by another replay on this machine (UDP port"
                    f" {ports_of(domain_id)[0] + _HELD}); expected a domain of its own"
                )
            self.domain_id, self._held, self._own = domain_id, held, False
            return
        # Linux hands out ports from 32768 on to whoever asks: domains up to 101 lie below them.
        for domain in random.sample(range(1, 102), 101):
            held = bound(ports_of(domain)[0] + _HELD)
            if held is None:
                continue
            self._own = True
            # Reserved first, then looked at: nobody else begins to use it in between.
            if unused(domain):
                self.domain_id, self._held = domain, held
                return
            held.close()
        raise ReplayError("every ROS domain from 1 to 101 is in use on this machine")

    def __enter__(self) -> int:
        return self.domain_id

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the domain after the processes' end, and remove leftovers of killed ones."""
        if self._own and self._held.fileno() >= 0 and unused(self.domain_id):
            remove_ports(self.domain_id)
        self._held.close()


def new_graph_id() -> str:
    """Return an identity for a graph, which its nodes' messages carry."""
    return uuid.uuid4().hex[:12]


def graph_environment(domain_id: int, log_dir: Path, graph_id: str = "") -> dict[str, str]:
    """Return the environment of the graph's processes: local discovery, shared memory, few threads."""
    own = {
        GRAPH_ID: graph_id,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(log_dir),
        "CSAS_PARENT_PID": str(os.getpid()),
        "CSAS_SINCE_S": repr(time.time()),
    }
    if free_shared_memory() >= _SHARED_MEMORY:
        profile = str(config_file("fastdds_shm.xml"))
        own |= {"FASTRTPS_DEFAULT_PROFILES_FILE": profile, "FASTDDS_DEFAULT_PROFILES_FILE": profile}
    own.setdefault("AMENT_PREFIX_PATH", os.environ.get("AMENT_PREFIX_PATH", sys.prefix))
    root = str(Path(__file__).resolve().parents[2])
    path = os.environ.get("PYTHONPATH", "")
    own["PYTHONPATH"] = f"{root}{os.pathsep}{path}" if path else root
    defaults = {**_MEMORY, **dict.fromkeys(THREADS_OF_LIBRARIES, "1")}
    return {**defaults, **os.environ, **own}


_environment_lock = threading.Lock()


@contextlib.contextmanager
def environment_of(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables temporarily; one thread at a time."""
    with _environment_lock:
        before = {name: os.environ.get(name) for name in values}
        os.environ.update(values)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


@contextlib.contextmanager
def signals_deferred() -> Iterator[None]:
    """Defer exceptions from signals, so that no participant stays half made."""
    if threading.current_thread() is not threading.main_thread():
        yield  # no signal is handled here
        return
    came: list[int] = []
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        handler = signal.getsignal(number)
        if callable(handler):
            before[number] = handler
            signal.signal(number, lambda n, _: came.append(n))
    try:
        yield
    finally:
        for n, handler in before.items():
            signal.signal(n, handler)
        for n in came:
            before[n](n, None)


class _Forked:
    """A child process that a `ForkServer` made; it is used as a `subprocess.Popen` is."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit status, minus the number of a signal that ended it; None while it runs."""
        if self.returncode is None:
            try:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
            except ChildProcessError:
                # Not ours yet (its maker is about to end), or no more: somebody else waited for it.
                if _exists(self.pid):
                    return None
                pid, status = self.pid, 1 << 8
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end.

        Raises
        ------
        subprocess.TimeoutExpired
            If it runs on.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if end is not None and time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            time.sleep(0.005)
        return code

    def send_signal(self, number: int) -> None:
        """Send it a signal if it runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


class ForkServer:
    """Forks node processes from one with their common modules loaded (`nodes.runtime.fork_server`).

    Parameters
    ----------
    environment : mapping
        Environment of the server and of all processes that it starts.
    log : Path
        Where its own output goes.

    Notes
    -----
    While it is open this process takes its descendants' orphans in, so that it is the nodes' parent.
    """

    def __init__(self, environment: Mapping[str, str], log: Path) -> None:
        _orphans.take_in()
        self._lock = threading.Lock()
        self._asked: deque[Future[int]] = deque()
        try:
            with log.open("ab") as output:
                self._server = subprocess.Popen(
                    # The player needs little, and reads the bag while the others' kernels are loaded.
                    [sys.executable, "-m", f"{PACKAGE}.nodes.runtime.fork_server", _START_ORDER[0]],
                    env=dict(environment),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=output,
                    text=True,
                    start_new_session=True,
                )
        except BaseException:
            _orphans.leave()
            raise
        self._reader = threading.Thread(target=self._read, name="fork server", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Id of the server's process."""
        return self._server.pid

    def start(self, node: str, arguments: Sequence[str], log: Path) -> Future[int]:
        """Request the start of a node; its process id, or an error, follows."""
        answer: Future[int] = Future()
        request = json.dumps({"node": node, "arguments": list(arguments), "log": str(log)})
        assert self._server.stdin is not None
        with self._lock:
            self._asked.append(answer)
            try:
                self._server.stdin.write(request + "\n")
                self._server.stdin.flush()
            except (OSError, ValueError) as error:
                self._asked.remove(answer)
                answer.set_exception(ReplayError(f"the fork server is gone: {error}"))
        return answer

    def _read(self) -> None:
        assert self._server.stdout is not None
        for line in self._server.stdout:
            answer = json.loads(line)
            with self._lock:
                if not self._asked:
                    continue
                asked = self._asked.popleft()
            if "pid" in answer:
                asked.set_result(answer["pid"])
            else:
                asked.set_exception(ReplayError(answer["error"]))
        with self._lock:
            left, self._asked = list(self._asked), deque()
            with contextlib.suppress(OSError):
                self._server.stdin.close()  # type: ignore[union-attr]
        for asked in left:
            asked.set_exception(ReplayError("the fork server has ended"))

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def kill(self) -> None:
        """Kill a server that does not answer, and whoever of its making is not a node yet.

        What is forked may hang as well, and holds the pipe of the answers: these would never end.
        """
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._server.pid, signal.SIGKILL)

    def end(self) -> None:
        """End the server: pending requests fail, its processes run on."""
        if self._server.poll() is None:
            self._server.terminate()
        with self._lock, contextlib.suppress(OSError):
            self._server.stdin.close()  # type: ignore[union-attr]
        try:
            self._server.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self.kill()
            self._server.wait()
        self._reader.join()

    def close(self) -> None:
        """End the server, and adopt no more orphans."""
        try:
            self.end()
        except BaseException:
            self.kill()
            self._server.wait()
            raise
        finally:
            if self._server.stdout is not None:
                self._server.stdout.close()
            _orphans.leave()


def start_fork_server(
    domain_id: int, log_dir: Path, graph_id: str = ""
) -> contextlib.AbstractContextManager[ForkServer | None]:
    """Start a fork server for a graph; None if the system has none.

    Parameters
    ----------
    domain_id : int
        ROS domain of the graph.
    log_dir : Path
        Where logs go.
    graph_id : str
        The graph's identity (`new_graph_id`).
    """
    log_dir.mkdir(parents=True, exist_ok=True)
    try:
        return ForkServer(graph_environment(domain_id, log_dir, graph_id), log_dir / "fork_server.log")
    except ReplayError:
        return contextlib.nullcontext()


class _Orphans:
    """Orphaned descendants become this process' children while somebody wants that."""

    _SET, _GET = 36, 37  # PR_SET_CHILD_SUBREAPER, PR_GET_CHILD_SUBREAPER of Linux

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wanted = 0
        self._before = 0

    def take_in(self) -> None:
        """Want it.

        Raises
        ------
        ReplayError
            If the system cannot do that.
        """
        with self._lock:
            if not self._wanted:
                before = ctypes.c_int(0)
                self._call(self._GET, ctypes.byref(before))
                self._call(self._SET, 1)
                self._before = before.value
            self._wanted += 1

    def leave(self) -> None:
        """Want it no more; for the last one all is as it was before."""
        with self._lock:
            self._wanted -= 1
            if not self._wanted:
                self._call(self._SET, self._before)

    @staticmethod
    def _call(option: int, value: Any) -> None:
        try:
            prctl = ctypes.CDLL(None, use_errno=True).prctl
        except (AttributeError, OSError) as error:
            raise ReplayError(f"no prctl here: {error}") from None
        if prctl(option, value, 0, 0, 0):
            raise ReplayError(f"prctl: {os.strerror(ctypes.get_errno())}")


_orphans = _Orphans()


class GraphProcess:
    """One node's process: starts, watches, restarts and ends it by its id.

    Parameters
    ----------
    node : str
        Name of the node.
    environment : mapping
        Its environment.
    log_dir : Path
        Where its output goes.
    parameter_file : Path, optional
        ROS parameter file.
    server : ForkServer, optional
        Starts it, as long as it can; by default the process is an interpreter of its own from the beginning.
    """

    def __init__(
        self,
        node: str,
        environment: Mapping[str, str],
        log_dir: Path,
        parameter_file: Path | None = None,
        server: ForkServer | None = None,
    ) -> None:
        self.node = node
        self.log = log_dir / f"{node}.log"
        self.restarts = -1
        self._environment = dict(environment)
        self._arguments = ["--ros-args", "--params-file", str(parameter_file)] if parameter_file else []
        self._server = server
        self._coming: Future[int] | None = None
        self._asked_s = 0.0
        self._process: subprocess.Popen[bytes] | _Forked | None = None
        self._log_file: IO[bytes] | None = None

    @property
    def pid(self) -> int:
        """Id of the running process; waits until there is one.

        Raises
        ------
        ReplayError
            If it was not started.
        """
        self._arrive(wait=True)
        if self._process is None:
            raise ReplayError(f"{self.node} was not started")
        return self._process.pid

    def start(self) -> None:
        """Start or restart the process."""
        self.restarts += 1
        self._process = None
        if self._server is None:
            self._start_alone()
        else:
            self._asked_s = time.monotonic()
            self._coming = self._server.start(self.node, self._all_arguments(), self.log)

    def _all_arguments(self) -> list[str]:
        again = _AGAIN.get(self.node) if self.restarts > 0 else None
        if again is None:
            return self._arguments
        return [*(self._arguments or ["--ros-args"]), "-p", again]

    def _start_alone(self) -> None:
        self.close_log()
        self._log_file = self.log.open("ab")
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"{PACKAGE}.nodes.{self.node}", *self._all_arguments()],
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=self._log_file,
            stderr=subprocess.STDOUT,
            # Not in the terminal's group: on Ctrl-C we end the processes ourselves, in order.
            start_new_session=True,
        )

    def _arrive(self, *, wait: bool, fall_back: bool = True) -> None:
        """Take the process from the server; start it alone if the server could not."""
        coming = self._coming
        if coming is None:
            return
        if self._server is not None and not coming.done():
            patience = self._asked_s + _PATIENCE_S - time.monotonic()
            if wait:
                futures.wait([coming], max(patience, 0.0))
                patience = 0.0
            if not coming.done():
                if patience <= 0.0:
                    self._server.kill()  # then the answer is an error, and comes soon
                if not wait:
                    return
        self._coming = None
        try:
            self._process = _Forked(coming.result())
        except ReplayError:
            if fall_back:
                self._start_alone()

    def poll(self) -> int | None:
        """Return the exit status, None while the process runs."""
        self._arrive(wait=False)
        return None if self._process is None else self._process.poll()

    def signal(self, number: int) -> None:
        """Send a signal if the process runs."""
        self._arrive(wait=True, fall_back=False)
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(number)

    def wait(self, timeout_s: float) -> None:
        """Wait for the process to end; kill it after the timeout."""
        if self._process is None:
            return
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    @property
    def killed(self) -> bool:
        """Whether a signal has ended the process."""
        code = None if self._process is None else self._process.poll()
        return code is not None and code < 0

    def close_log(self) -> None:
        """Close the log file."""
        if self._log_file is not None:
            self._log_file.close()
            self._log_file = None

    def last_line(self) -> str:
        """Return the last line of the process' output."""
        text = self.log.read_text(errors="replace").strip() if self.log.exists() else ""
        if says_that_it_stood_still(text):
            return f"it stood still for {STANDS_STILL_S:g} s; {self.log} has the stack of every thread"
        return text.splitlines()[-1] if text else "no output"


class Graph:
    """The processes of a graph; leaving it ends them all.

    Parameters
    ----------
    parameters : mapping of node name to mapping of parameter name to value
        One process is started for each node named.
    domain_id : int
        ROS domain.
    log_dir : Path
        Where logs and the parameter file go.
    max_restarts : int
        How often each node may die and be started again.
    server : ForkServer, optional
        Starts the processes; by default each is an interpreter of its own from the beginning.
    graph_id : str
        The graph's identity (`new_graph_id`), as of the fork server; empty: none.
    """

    def __init__(
        self,
        parameters: Mapping[str, Mapping[str, Any]],
        domain_id: int,
        log_dir: Path,
        max_restarts: int = 3,
        server: ForkServer | None = None,
        graph_id: str = "",
    ) -> None:
        check(parameters)
        log_dir.mkdir(parents=True, exist_ok=True)
        self.graph_id = graph_id
        self.environment = graph_environment(domain_id, log_dir, graph_id)
        file = log_dir / "parameters.yaml"
        file.write_text(yaml_text(parameters, only_given=True), encoding="utf-8")
        self._server = server
        has_own = {name for name, own in parameters.items() if own}
        self.processes = {
            name: GraphProcess(name, self.environment, log_dir, file if name in has_own else None, server)
            for name in parameters
        }
        self.parameters = parameters
        self.max_restarts = max_restarts
        #: One line for each process that died.
        self.deaths: list[str] = []
        self._began_s = self._death_s = 0.0

    def __enter__(self) -> Graph:
        self._began_s = time.time()
        # What a graph left whose launching process was killed together with its nodes.
        remove_strays(until_s=self._began_s - LONG_LOCKED_S)
        try:
            for process in sorted(self.processes.values(), key=lambda p: _START_ORDER.index(p.node)):
                process.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def watch(self) -> None:
        """Restart processes that have died.

        Raises
        ------
        ReplayError
            If a node refuses its parameters or its bag, or died too often; the message has its last line.
        """
        for name, process in self.processes.items():
            code = process.poll()
            if code is None:
                continue
            if code not in (0, 2):  # killed, or ended by itself where it stood
                self._death_s = time.time()
            if code == 2:
                raise ReplayError(f"{name} refused to start: {process.last_line()}")
            how = f"was killed by signal {-code}" if code < 0 else f"ended with status {code}"
            self.deaths.append(f"{name} {how}: {process.last_line()}")
            if process.restarts >= self.max_restarts:
                raise ReplayError(f"{name} died {process.restarts + 1} times; {self.deaths[-1]}")
            process.start()
        if self._death_s and time.time() > self._death_s + 1.1 * LOCKED_S:
            # Nobody else removes the shared memory of a process that was killed, before the next boot.
            self._death_s = 0.0
            remove_strays(self._began_s)

    def stop(self) -> None:
        """End all processes: first by request, so that a recorder finishes its bag, then by force."""
        try:
            if self._server is not None:
                self._server.end()
            for process in self.processes.values():
                process.signal(signal.SIGINT)
            for name, process in self.processes.items():
                process.wait(30.0 if name == "bag_recorder" else 5.0)
                process.close_log()
                if process.killed:
                    self._death_s = time.time()
            if self._death_s:
                # Also of processes that were killed as soon as they had begun, or just now.
                time.sleep(max(0.0, self._death_s + 1.1 * LOCKED_S - time.time()))
                remove_strays(self._began_s)
                self._death_s = 0.0
        except BaseException:
            # Another Ctrl-C: no process is left behind for that, not even as a zombie.
            if self._server is not None:
                self._server.kill()
            for process in self.processes.values():
                process.signal(signal.SIGKILL)
            for process in self.processes.values():
                process.wait(5.0)
                process.close_log()
            remove_strays(self._began_s)
            raise
