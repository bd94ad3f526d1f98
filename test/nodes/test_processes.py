"""The graph as real processes: killed with SIGKILL, ended with SIGINT, refusing what they cannot do."""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import re
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, STEP_DEG

from csas_shadow_ros.bags import read_run, write_run
from csas_shadow_ros.core.errors import BagError, NoTargetError, ParameterError, SpectrumSignError
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import ProcessedView, Result, run
from csas_shadow_ros.graph import processes as graph_module
from csas_shadow_ros.graph import replay as module
from csas_shadow_ros.graph.processes import (
    DomainReservation,
    Graph,
    GraphProcess,
    ReplayError,
    graph_environment,
    start_fork_server,
)
from csas_shadow_ros.graph.replay import replay
from csas_shadow_ros.nodes.runtime import hearing
from csas_shadow_ros.nodes.runtime.shared_memory import (
    owned_files,
    ports_of,
    remove_ports,
    remove_unmade_ports,
    segments_of,
)
from csas_shadow_ros.simulation import SimulatedRun
from msg_adapters import Heartbeat

Reference = tuple[Result, list[ProcessedView]]


def assert_same_grid(result: module.ReplayResult, reference: Reference) -> None:
    """Compare with the in-process pipeline, bit for bit."""
    expected = reference[0].grid
    assert result.grid is not None
    assert expected is not None
    np.testing.assert_array_equal(result.grid.likelihood, expected.likelihood)
    np.testing.assert_array_equal(result.grid.occupied, expected.occupied)
    assert result.grid.threshold == expected.threshold
    assert result.views_used == reference[0].views_used


def alive(pid: int) -> bool:
    """Say whether a process runs (a zombie does not)."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> list[Graph]:
    """The graphs that replays have started, the last one last."""
    started: list[Graph] = []

    class Watched(Graph):
        def __enter__(self) -> Graph:
            started.append(self)
            return super().__enter__()

    monkeypatch.setattr(module, "Graph", Watched)
    return started


#: Views enough that a run is not over while the replay listens: it does so ten times a second.
LONG = replace(PARAMETERS, sub_aperture=SubApertureParameters(step_deg=2.0))


@pytest.fixture(scope="module")
def reference_of_long(simulated: SimulatedRun) -> Reference:
    """The run with as many views in one process."""
    return run(simulated.image, simulated.track, LONG), []


def test_every_process_killed_once_in_mid_run_and_the_grid_and_the_recording_are_the_same(
    run_bag: Path, reference_of_long: Reference, tmp_path: Path, graphs: list[Graph]
) -> None:
    order = ["shadow_enhancement", "voxel_carver", "sub_aperture", "shadow_likelihood"]
    order += ["bag_recorder", "bag_player"]
    pids: list[int] = []
    victims: list[str] = []

    def kill_as_it_goes(done: int, total: int) -> None:
        # One every so many views; the recorder and the player too.
        if len(victims) < len(order) and done >= 3 + 12 * len(victims) and done < total:
            process = graphs[-1].processes[order[len(victims)]]
            victims.append(process.node)
            pids.append(process.pid)
            os.kill(process.pid, signal.SIGKILL)

    deaths: list[str] = []
    for attempt in range(3):  # a busy machine may hear of the whole short run at once: then nobody was killed
        folder = tmp_path / str(attempt)
        for told in (victims, deaths, pids):
            told.clear()
        result = replay(
            run_bag,
            folder,
            LONG,
            record=True,
            composites=False,
            progress=kill_as_it_goes,
            notice=deaths.append,
        )
        if len(victims) >= 3:
            break
    assert len(victims) >= 3, f"the run was over before more could be killed: {victims}"
    assert len(deaths) == len(victims)
    assert all(f"{name} was killed by signal 9" in line for name, line in zip(victims, deaths, strict=True))
    assert_same_grid(result, reference_of_long)
    assert result.lost == 0
    assert {name: result.nodes[name].restarts for name in victims if name in result.nodes} == {
        name: 1 for name in victims if name in result.nodes
    }
    recorded = read_run(folder / "recording")
    for stream in ("sub_aperture", "shadow", "likelihood", "shadow_mask"):
        assert recorded.counts[stream] == result.views_total, stream
    pids += [p.pid for p in graphs[-1].processes.values()]
    assert not [pid for pid in pids if alive(pid)], "no process is left"


def test_a_replay_reports_refused_views_with_their_aspect_and_what_each_node_did(
    simulated: SimulatedRun, tmp_path: Path
) -> None:
    from csas_shadow_ros.core.geometry import Track

    track = simulated.track
    keep = np.degrees(track.aspects_rad) % 360.0
    keep = (keep < 100.0) | (keep > 140.0)
    gap = Track(track.stamps_ns[keep], track.positions_m[keep])
    bag = write_run(tmp_path / "gap", simulated.image, gap)
    seen: list[tuple[int, int]] = []
    result = replay(bag, tmp_path / "out", PARAMETERS, progress=lambda d, t: seen.append((d, t)))
    refused = sorted(r.aspect_deg for r in result.rejected if r.node == "sub_aperture")
    assert refused
    assert all(95.0 <= a <= 145.0 for a in refused), refused
    assert all("track gap" in r.reason for r in result.rejected if r.node == "sub_aperture")
    assert result.views_total == 360.0 / STEP_DEG - len(refused)
    assert result.grid is not None
    assert result.mesh is not None
    assert result.dimensions is not None
    assert result.composites["color_by_aspect"].dtype == np.uint8
    assert result.nodes["voxel_carver"].busy_s > 0
    assert seen[-1] == (result.views_total, result.views_total)


@pytest.mark.parametrize(
    ("bag", "parameters", "error", "message"),
    [
        ("nowhere", {}, BagError, "there is no bag at"),
        ("run_bag", {"overrides": {"voxel_carver": {"voxel_size_m": -1.0}}}, ParameterError, "voxel_carver"),
        ("run_bag", {"overrides": {"voxel_craver": {}}}, ParameterError, "unknown node 'voxel_craver'"),
        ("run_bag", {"stage": "likelihood"}, BagError, "holds no likelihood"),
        ("likelihood", {"parameters": PipelineParameters()}, ParameterError, "method is"),
        ("shadow_mask", {}, NoTargetError, "do not tell how large the target is"),
    ],
)
def test_what_cannot_be_replayed_is_refused_before_any_process_starts(
    request: pytest.FixtureRequest,
    view_bag: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    bag: str,
    parameters: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    path = {"nowhere": Path("/nowhere")}.get(bag) or (
        request.getfixturevalue("run_bag") if bag == "run_bag" else view_bag(bag)
    )
    with pytest.raises(error, match=message):
        replay(path, progress=False, **parameters)


def test_an_error_of_a_node_is_raised_as_the_pipeline_raises_it_and_no_process_is_left(
    simulated: SimulatedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataclasses import replace

    graphs: list[Graph] = []
    enter = Graph.__enter__
    monkeypatch.setattr(Graph, "__enter__", lambda self: graphs.append(self) or enter(self))
    image = replace(simulated.image, acoustics=replace(simulated.image.acoustics, spectrum_sign=-1))
    bag = write_run(tmp_path / "wrong", image, simulated.track)
    with pytest.raises(SpectrumSignError, match="shadows fall towards the sonar"):
        replay(bag, tmp_path / "out", PARAMETERS, progress=False)
    pids = []
    for process in graphs[0].processes.values():
        with contextlib.suppress(ReplayError):  # the error may come before the last one is started
            pids.append(process.pid)
    assert pids
    assert not [pid for pid in pids if alive(pid)]


def run_node(name: str, *arguments: str, log_dir: Path, domain: int) -> subprocess.Popen[str]:
    environment = {k: v for k, v in graph_environment(domain, log_dir).items() if k != "CSAS_PARENT_PID"}
    return subprocess.Popen(
        [sys.executable, "-m", f"csas_shadow_ros.nodes.{name}", "--ros-args", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("voxel_size_m:=0.0", "voxel_carver: voxel_size_m is 0.0 m; expected a number in [0.0001, 1000] m"),
        ("voxelsize:=1.0", "voxel_carver: unknown parameter 'voxelsize'; expected one of: "),
        ("target:=given", "voxel_carver: size_m is [0.0, 0.0, 0.0]; expected x, y, z > 0 m with a given"),
    ],
)
def test_a_node_ends_with_status_2_and_one_clear_line_where_a_parameter_is_wrong(
    domain: int, tmp_path: Path, argument: str, message: str
) -> None:
    process = run_node("voxel_carver", "-p", argument, log_dir=tmp_path, domain=domain)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert stderr.strip().splitlines()[-1].startswith(message)
    assert "Traceback" not in stderr


def test_a_recorder_that_is_interrupted_finishes_its_bag(domain: int, tmp_path: Path) -> None:
    out = tmp_path / "recording"
    process = run_node("bag_recorder", "-p", f"out:={out}", log_dir=tmp_path, domain=domain)
    deadline = time.monotonic() + 60
    while not list(out.glob("*.mcap")):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 0, stderr
    assert (out / "metadata.yaml").exists()


def test_a_recorder_that_is_ended_in_mid_run_goes_on_with_its_bag(
    run_bag: Path, reference_of_long: Reference, tmp_path: Path, graphs: list[Graph]
) -> None:
    ended: list[int] = []

    def end_it(done: int, total: int) -> None:
        if not ended and 2 <= done < total - 2:
            ended.append(done)
            # As a system that is told to stop one service does; the recorder finishes its bag and is gone.
            graphs[-1].processes["bag_recorder"].signal(signal.SIGTERM)

    for attempt in range(3):  # a busy machine may hear of the whole short run at once
        folder = tmp_path / str(attempt)
        result = replay(run_bag, folder, LONG, record=True, composites=False, progress=end_it)
        if ended:
            break
    assert ended
    assert_same_grid(result, reference_of_long)
    recorded = read_run(folder / "recording")
    for stream in ("sub_aperture", "shadow", "likelihood", "shadow_mask"):
        assert recorded.counts[stream] == result.views_total, stream


def test_a_recording_that_is_there_is_refused_unless_it_is_to_be_gone_on_with(
    domain: int, run_bag: Path, tmp_path: Path
) -> None:
    recording = ("-p", f"out:={run_bag}")
    process = run_node("bag_recorder", *recording, log_dir=tmp_path, domain=domain)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "exists" in stderr
    assert read_run(run_bag).require_track()


def test_a_results_folder_that_is_a_file_is_refused_by_name(run_bag: Path, tmp_path: Path) -> None:
    file = tmp_path / "results"
    file.write_text("mine")
    with pytest.raises(ParameterError, match=r"out_dir is '.*results' .*expected a folder"):
        replay(run_bag, file, progress=False)
    with pytest.raises(ParameterError, match=r"out_dir is '.*below' .*expected a folder"):
        replay(run_bag, file / "below", progress=False)
    assert file.read_text() == "mine"


@pytest.mark.parametrize("forked", [False, True])
def test_nodes_end_when_the_process_that_started_them_was_killed(tmp_path: Path, forked: bool) -> None:
    code = (
        "import sys, time; from pathlib import Path\n"
        "from csas_shadow_ros.graph.processes import DomainReservation, Graph, start_fork_server\n"
        f"held = DomainReservation(); d, log = held.domain_id, Path({str(tmp_path)!r})\n"
        f"server = start_fork_server(d, log).__enter__() if {forked} else None\n"
        "g = Graph({'composites': {}}, d, log, server=server)\n"
        "g.__enter__(); print(g.processes['composites'].pid, server and server.pid, flush=True)\n"
        "time.sleep(600)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(module.__file__).parents[2])}
    command = [sys.executable, "-c", code]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    pids = [int(word) for word in parent.stdout.readline().split() if word != "None"]
    assert len(pids) == 1 + forked
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 30
    while any(map(alive, pids)):
        assert time.monotonic() < deadline, "the node outlives its parent"
        time.sleep(0.1)


def running(graph: Graph, log_dir: Path, node: str) -> None:
    """Wait until a node's process takes part in the middleware."""
    deadline = time.monotonic() + 60
    pid = graph.processes[node].pid
    while not (
        segments_of(pid) and [f for f in os.listdir(f"/proc/{pid}/task") if _name(pid, f).startswith("dds.")]
    ):
        assert time.monotonic() < deadline, (log_dir / f"{node}.log").read_text()
        time.sleep(0.05)


def _name(pid: int, task: str) -> str:
    try:
        return Path(f"/proc/{pid}/task/{task}/comm").read_text()
    except OSError:
        return ""


def segments() -> set[str]:
    """Return the names of the middleware's shared memory."""
    return {name for name in os.listdir("/dev/shm") if name.startswith(("fastrtps_", "sem.fastrtps_"))}


@pytest.mark.parametrize("forked", [False, True])
def test_processes_that_end_leave_no_shared_memory(domain: int, tmp_path: Path, forked: bool) -> None:
    before = segments()
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(start_fork_server(domain, tmp_path)) if forked else None
        nodes: dict[str, dict[str, Any]] = {"composites": {}, "shadow_likelihood": {}}
        graph = stack.enter_context(Graph(nodes, domain, tmp_path, server=server))
        for node in graph.processes:
            running(graph, tmp_path, node)
        assert segments() - before
    assert segments() <= before


@pytest.mark.parametrize("forked", [False, True])
def test_the_shared_memory_of_a_killed_node_is_taken_away_and_no_other(
    domain: int, tmp_path: Path, forked: bool
) -> None:
    before = segments()

    def owned(pid: int) -> set[str]:
        return {path.name for path in segments_of(pid)}

    with contextlib.ExitStack() as stack:
        server = stack.enter_context(start_fork_server(domain, tmp_path)) if forked else None
        nodes: dict[str, dict[str, Any]] = {"composites": {}, "shadow_likelihood": {}}
        graph = stack.enter_context(Graph(nodes, domain, tmp_path, server=server))
        for node in graph.processes:
            running(graph, tmp_path, node)
        graph.watch()  # as a replay does all the time
        victim, other = graph.processes["composites"].pid, graph.processes["shadow_likelihood"].pid
        lost, kept = owned(victim), owned(other)
        assert lost
        assert kept
        os.kill(victim, signal.SIGKILL)
        deadline = time.monotonic() + 30
        while not graph.deaths or lost & segments():
            assert time.monotonic() < deadline
            graph.watch()
            time.sleep(0.05)
        assert kept <= segments()
        running(graph, tmp_path, "composites")
        assert owned(graph.processes["composites"].pid) <= segments()
        # A last one is killed as the graph ends: nobody starts it again.
        os.kill(graph.processes["composites"].pid, signal.SIGKILL)
    assert not {name for name in segments() - before if "_port" not in name}


def test_nodes_outlive_the_process_that_forked_them_and_are_started_again_without_it(
    domain: int, tmp_path: Path
) -> None:
    with start_fork_server(domain, tmp_path) as server:
        assert server is not None
        with Graph({"composites": {}, "shadow_likelihood": {}}, domain, tmp_path, server=server) as graph:
            pids = {name: process.pid for name, process in graph.processes.items()}
            stats = [Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split() for pid in pids.values()]
            parents = {stat[1] for stat in stats}
            assert parents == {str(os.getpid())}
            os.kill(server.pid, signal.SIGKILL)
            os.kill(pids["composites"], signal.SIGKILL)
            deadline = time.monotonic() + 30
            while not graph.deaths:
                assert time.monotonic() < deadline
                graph.watch()
                time.sleep(0.02)
            assert graph.deaths[0].startswith("composites was killed by signal 9")
            running(graph, tmp_path, "composites")
            assert graph.processes["composites"].pid != pids["composites"]
            assert alive(pids["shadow_likelihood"])
            assert graph.processes["shadow_likelihood"].poll() is None
    assert not [pid for pid in pids.values() if alive(pid)]


def test_a_graph_that_is_left_before_its_nodes_are_there_leaves_none(domain: int, tmp_path: Path) -> None:
    nodes = ("bag_player", "sub_aperture", "shadow_enhancement", "shadow_likelihood", "voxel_carver")
    with start_fork_server(domain, tmp_path) as server:
        assert server is not None
        with Graph({name: {} for name in nodes}, domain, tmp_path, server=server):
            pass
        environment = f"ROS_DOMAIN_ID={domain}\0".encode()
        left = [
            path.parent.name
            for path in Path("/proc").glob("[0-9]*/environ")
            if readable(path) and environment in path.read_bytes() and path.parent.name != str(server.pid)
        ]
        assert not left


def test_a_fork_server_that_does_not_answer_holds_nobody_up(domain: int, tmp_path: Path) -> None:
    with start_fork_server(domain, tmp_path) as server:
        assert server is not None
        os.kill(server.pid, signal.SIGSTOP)
        began = time.monotonic()
        with Graph({"composites": {}, "shadow_likelihood": {}}, domain, tmp_path, server=server) as graph:
            assert graph.processes["composites"].poll() is None
        assert time.monotonic() - began < 20.0
        assert not alive(server.pid)


def test_a_node_is_started_without_a_fork_server_that_takes_too_long(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph_module, "_PATIENCE_S", 0.5)
    with start_fork_server(domain, tmp_path) as server:
        assert server is not None
        os.kill(server.pid, signal.SIGSTOP)
        with Graph({"composites": {}}, domain, tmp_path, server=server) as graph:
            running(graph, tmp_path, "composites")
            assert graph.processes["composites"].poll() is None


def test_an_interrupt_while_processes_are_ended_leaves_none(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pids: list[int] = []
    waited = GraphProcess.wait
    calls: list[str] = []

    def interrupted(self: GraphProcess, timeout_s: float) -> None:
        calls.append(self.node)
        if len(calls) == 1:
            raise KeyboardInterrupt
        waited(self, timeout_s)

    with start_fork_server(domain, tmp_path) as server:
        graph = Graph({"composites": {}, "shadow_likelihood": {}}, domain, tmp_path, server=server)
        with graph:
            pids = [process.pid for process in graph.processes.values()]
            monkeypatch.setattr(GraphProcess, "wait", interrupted)
            with pytest.raises(KeyboardInterrupt):
                graph.stop()
    assert len(pids) == 2
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()], "not even a zombie"


def test_a_terminated_replay_leaves_no_process_and_no_shared_memory(run_bag: Path, tmp_path: Path) -> None:
    before = segments()
    environment = {**os.environ, "PYTHONPATH": str(Path(module.__file__).parents[2])}
    out = str(tmp_path / "out")
    command = [sys.executable, "-m", "csas_shadow_ros.cli", "replay", str(run_bag), "--out", out]
    cli = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while len(segments() - before) < 8:
        assert time.monotonic() < deadline
        assert cli.poll() is None
        time.sleep(0.02)
    children = Path(f"/proc/{cli.pid}/task/{cli.pid}/children").read_text().split()
    assert children
    cli.terminate()
    assert cli.wait(30) == 128 + signal.SIGTERM
    assert not [pid for pid in children if alive(int(pid))]
    assert segments() <= before
    assert not list(tmp_path.glob("*incomplete*"))


def test_a_replay_that_is_killed_with_a_node_of_its_graph_leaves_no_process_and_no_shared_memory(
    run_bag: Path, tmp_path: Path
) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(module.__file__).parents[2])}
    command = [sys.executable, "-m", "csas_shadow_ros.cli", "replay", str(run_bag), "--out"]
    cli = subprocess.Popen(
        [*command, str(tmp_path / "out")],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    children = Path(f"/proc/{cli.pid}/task/{cli.pid}/children")
    nodes: dict[int, set[Path]] = {}
    deadline = time.monotonic() + 60
    while len(nodes) < 7 or not segments_of(cli.pid):
        assert time.monotonic() < deadline
        assert cli.poll() is None
        nodes |= {int(pid): found for pid in children.read_text().split() if (found := segments_of(int(pid)))}
        time.sleep(0.02)
    owned = set.union(*nodes.values(), segments_of(cli.pid))
    time.sleep(1.0)  # what is made just before the kill is left to the next graph: nobody knows whose it is
    os.kill(min(nodes), signal.SIGKILL)
    cli.kill()
    cli.wait()
    deadline = time.monotonic() + 60
    while [pid for pid in nodes if alive(pid)] or [path for path in owned if path.exists()]:
        assert time.monotonic() < deadline, [path for path in owned if path.exists()]
        time.sleep(0.05)


def test_a_node_that_begins_while_another_process_holds_its_port_waits_until_it_hears(
    domain: int, tmp_path: Path
) -> None:
    # As one that was killed just before does, on a busy machine.
    port = Path(f"/dev/shm/fastrtps_port{7400 + 250 * domain + 11}_el")
    with port.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with Graph({"composites": {}}, domain, tmp_path) as graph:
            pid = graph.processes["composites"].pid
            deadline = time.monotonic() + 60
            while "open_and_lock_file failed" not in graph.processes["composites"].log.read_text():
                assert time.monotonic() < deadline
                time.sleep(0.05)
            fcntl.flock(lock, fcntl.LOCK_UN)
            ports: list[str] = []
            while len(ports) != 2:  # whichever: the middleware may count on
                assert time.monotonic() < deadline, ports
                assert graph.processes["composites"].poll() is None
                names = [os.path.basename(path) for path in links(pid)]
                ports = [name for name in names if "_port" in name and name.endswith("_el")]
                time.sleep(0.05)


# Has files open, and replaces them when it is told to.
HOLDS = """
import mmap, os, sys
opened = [mmap.mmap(os.open(path, os.O_RDWR), 0) for path in sys.argv[1:]]
print("holds", flush=True)
input()
for path in sys.argv[1:]:
    os.unlink(path)
print("removed", flush=True)
input()
"""


@contextlib.contextmanager
def holding(*paths: Path | str) -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """Have another process hold files open; give what has it remove them, and what ends it."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, *map(str, paths)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as holder:
        assert holder.stdin is not None
        assert holder.stdout is not None
        assert holder.stdout.readline() == "holds\n"

        def remove() -> None:
            holder.stdin.write("\n")
            holder.stdin.flush()
            assert holder.stdout.readline() == "removed\n"

        def end() -> None:
            holder.kill()
            holder.wait()

        yield remove, end
        holder.kill()


@pytest.fixture
def port() -> Iterator[Path]:
    """A file that this process owns as the middleware does a port's."""
    file = Path(f"/dev/shm/fastrtps_port{70_000 + os.getpid()}")
    owner = file.with_name(f"{file.name}_el")
    file.write_bytes(b"\0" * 4096)
    with owner.open("w"):
        yield file
    for path in (file, owner):
        path.unlink(missing_ok=True)


def test_it_is_found_out_that_others_write_to_a_file_that_a_port_has_replaced(
    port: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hearing, "_LOOKS_S", (0.0, 0.0))
    with contextlib.ExitStack() as stack:
        remove, end = stack.enter_context(holding(port))
        assert [hearing.Reach().is_lost() for _ in range(3)] == [False] * 3, "the one that is read"
        remove()
        port.write_bytes(b"\0" * 4096)
        reach = hearing.Reach()
        assert [reach.is_lost() for _ in range(3)] == [False, True, False], "twice seen, once said"
        assert reach.is_given_up
        reach = hearing.Reach()
        assert not reach.is_lost()
        end()
        assert not reach.is_lost(), "as a rule it is let go of"
        assert not reach.is_given_up


def test_it_is_found_out_that_an_own_port_was_replaced(port: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hearing, "_LOOKS_S", ())
    monkeypatch.setattr(hearing, "_OWN_LOOK_S", 0.0)
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(port.open("r+b"))
        stack.enter_context(mmap.mmap(file.fileno(), 0))
        reach = hearing.Reach()
        assert not reach.is_lost()
        port.unlink()
        port.write_bytes(b"\0" * 4096)
        assert reach.is_lost()
        assert reach.is_given_up


def test_a_fork_server_that_is_killed_answers_also_if_what_it_forked_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "stuck" / "nodes" / "runtime"
    package.mkdir(parents=True)
    (package / "fork_server.py").write_text("import os, time\nos.fork()\ntime.sleep(600)\n")
    monkeypatch.setattr(graph_module, "PACKAGE", "stuck")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    with graph_module.ForkServer(environment, tmp_path / "log") as server:
        coming = server.start("composites", [], tmp_path / "log")
        group = server.pid
        while len(members(group)) < 2:
            time.sleep(0.05)
        server.kill()
        with pytest.raises(ReplayError, match="the fork server has ended"):
            coming.result(timeout=30)
        end = time.monotonic() + 30.0
        while members(group):  # a killed process ends a moment later
            assert time.monotonic() < end, members(group)
            time.sleep(0.02)


def members(group: int) -> list[int]:
    """Return the running processes of a process group."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of_group = entry.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state != "Z":
                found.append(int(entry.parent.name))
    return found


def test_what_forks_nodes_has_started_no_thread_that_computes() -> None:
    code = """
import os
from csas_shadow_ros.nodes.runtime import fork_server
from csas_shadow_ros.nodes.runtime.params import NODES
before = len(os.listdir("/proc/self/task"))  # the middleware's tracing has some
fork_server._threads_of_images(1)
for node in NODES:
    fork_server.load(node)
print(before, len(os.listdir("/proc/self/task")))
"""
    environment = {**os.environ, **dict.fromkeys(graph_module.THREADS_OF_LIBRARIES, "1")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    before, after = done.stdout.split()
    assert after == before


def test_views_that_are_sent_again_and_again_are_no_progress_of_a_replay() -> None:
    def at(**counts: int) -> tuple[str, int, int, int]:
        return module._got_through(Heartbeat(0, "sub_aperture", "s-1", "source", counts))

    before = at(done=3, sent=9, resends=5, **{"in": 4}, duplicates=2)
    assert at(done=3, sent=13, resends=9, **{"in": 8}, duplicates=6) == before
    assert at(done=4, sent=9, resends=5, **{"in": 4}, duplicates=2) != before
    assert at(done=3, sent=9, resends=5, **{"in": 5}, duplicates=2) != before


def test_the_port_of_a_killed_process_is_avoided_as_long_as_others_write_to_it(port: Path) -> None:
    owner = port.with_name(f"{port.name}_el")
    with holding(port) as (_, end):
        with owner.open("rb") as alive:
            fcntl.flock(alive, fcntl.LOCK_EX)
            with hearing.avoid_dead_ports() as avoided:
                assert str(port) not in avoided, "it has a reader"
        with owner.open("rb") as another:
            with hearing.avoid_dead_ports() as avoided:
                assert str(port) in avoided
                with pytest.raises(BlockingIOError):
                    fcntl.flock(another, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.flock(another, fcntl.LOCK_EX | fcntl.LOCK_NB)
        end()
        with hearing.avoid_dead_ports() as avoided:
            assert str(port) not in avoided, "nobody writes to it"


@pytest.mark.parametrize("size", [0, 206_000], ids=["without a length", "without contents"])
def test_a_port_that_its_killed_maker_left_unmade_holds_nobody_up(
    domain: int, tmp_path: Path, size: int
) -> None:
    unmade = Path(f"/dev/shm/fastrtps_port{ports_of(domain)[11]}")  # the first that a participant opens
    unmade.write_bytes(bytes(size))
    os.utime(unmade, (time.time() - 60.0,) * 2)
    fresh = unmade.with_name(f"{unmade.name}0")
    fresh.write_bytes(bytes(size))
    try:
        assert remove_unmade_ports() == [unmade]
        assert fresh.exists(), "it may be in the making"
        unmade.write_bytes(bytes(size))
        os.utime(unmade, (time.time() - 60.0,) * 2)
        with Graph({"composites": {}}, domain, tmp_path) as graph:
            deadline = time.monotonic() + 60
            while ": active" not in graph.processes["composites"].log.read_text():
                assert time.monotonic() < deadline
                time.sleep(0.05)
    finally:
        fresh.unlink(missing_ok=True)


@pytest.mark.parametrize("size", [0, 206_000], ids=["without a length", "without contents"])
def test_who_waits_for_an_unmade_port_goes_on_once_its_domain_is_tidied(domain: int, size: int) -> None:
    unmade = Path(f"/dev/shm/fastrtps_port{ports_of(domain)[11]}")
    unmade.write_bytes(bytes(size))
    with unmade.open("rb") as waiting:
        remove_ports(domain)
        assert not unmade.exists()
        assert waiting.read(4) == (3).to_bytes(4, sys.byteorder), "Boost gives it up as corrupt"


@pytest.mark.parametrize("size", [0, 206_000], ids=["without a length", "without contents"])
def test_a_fork_server_removes_unmade_ports_as_all_nodes_may_wait_for_one(
    domain: int, tmp_path: Path, size: int
) -> None:
    unmade = Path(f"/dev/shm/fastrtps_port{ports_of(domain)[11]}")
    with start_fork_server(domain, tmp_path):
        unmade.write_bytes(bytes(size))
        deadline = time.monotonic() + 60
        while unmade.exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_a_successor_takes_other_ports_than_the_killed_node_that_others_still_write_to(
    domain: int, tmp_path: Path
) -> None:
    plan: dict[str, dict[str, Any]] = {"composites": {}, "shadow_likelihood": {}}
    with Graph(plan, domain, tmp_path) as graph:
        process = graph.processes["composites"]

        def ports() -> set[str]:
            return {os.path.basename(path) for path in owned_files(process.pid) if "_port" in path}

        def written() -> set[str]:
            maps = Path(f"/proc/{graph.processes['shadow_likelihood'].pid}/maps").read_text()
            return set(re.findall(r"fastrtps_port\d+", maps))

        deadline = time.monotonic() + 120
        while len(before := ports()) != 2 or not before <= written():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        pid = process.pid
        os.kill(pid, signal.SIGKILL)
        told = process.log.read_text().count(": active")
        while process.pid == pid or process.log.read_text().count(": active") == told:
            assert time.monotonic() < deadline
            graph.watch()
            time.sleep(0.05)
        assert len(ports() - before) == 2
        assert not ports() & before


@pytest.mark.long
def test_a_node_whose_ports_were_replaced_begins_anew_at_other_ports(
    domain: int, tmp_path: Path
) -> None:
    with Graph({"composites": {}}, domain, tmp_path) as graph:
        process = graph.processes["composites"]

        def ports() -> list[str]:
            owned = [path for path in links(process.pid) if "_port" in path and path.endswith("_el")]
            return [path.removesuffix("_el") for path in owned]

        deadline = time.monotonic() + 120
        while len(ports()) != 2:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        before = set(ports())
        pid = process.pid
        with holding(*before) as (remove, _):  # for good
            remove()
            while "begins anew" not in process.log.read_text():
                assert time.monotonic() < deadline
                graph.watch()
                time.sleep(0.05)
            time.sleep(15.0)
            assert process.log.read_text().count("begins anew") == 1
            assert process.poll() is None
            assert process.pid == pid
            assert len({path for path in ports() if Path(path).exists()} - before) == 2
            assert process.log.read_text().rstrip().splitlines()[-1].split("]: ")[1].startswith("active")


def links(pid: int) -> list[str]:
    found = []
    for entry in os.listdir(f"/proc/{pid}/fd"):
        with contextlib.suppress(OSError):
            found.append(os.readlink(f"/proc/{pid}/fd/{entry}"))
    return found


def test_a_graph_removes_what_a_killed_one_left_of_shared_memory_and_nothing_that_has_an_owner(
    domain: int, tmp_path: Path
) -> None:
    names = {age_s: Path(f"/dev/shm/fastrtps_{uuid.uuid4().hex[:16]}") for age_s in (3600.0, 3601.0, 5.0)}
    with contextlib.ExitStack() as stack:
        for age_s, segment in names.items():
            for path in (segment, segment.with_name(f"{segment.name}_el")):
                path.write_bytes(b"1")
                stack.callback(path.unlink, missing_ok=True)
                os.utime(path, (time.time() - age_s,) * 2)
        lock = stack.enter_context(names[3601.0].with_name(f"{names[3601.0].name}_el").open())
        fcntl.flock(lock, fcntl.LOCK_EX)
        with Graph({}, domain, tmp_path):
            left = {age_s for age_s, segment in names.items() if segment.exists()}
    assert left == {3601.0, 5.0}, "one has an owner, and the owner of another may just be about to lock it"


@pytest.mark.parametrize("domain_id", [-1, 233, "7", True, 1.0])
def test_a_domain_that_does_not_exist_is_refused(run_bag: Path, domain_id: Any) -> None:
    with pytest.raises(ParameterError, match=r"domain_id is .*; expected a whole number from 0 to 232"):
        replay(run_bag, parameters=PARAMETERS, domain_id=domain_id, progress=False)


def test_variables_are_put_back_whoever_else_sets_some(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CSAS_TEST_KEPT", "before")
    monkeypatch.delenv("CSAS_TEST_NEW", raising=False)
    inside, leave = threading.Event(), threading.Event()

    def other() -> None:
        with graph_module.environment_of({"CSAS_TEST_KEPT": "other", "CSAS_TEST_NEW": "other"}):
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    thread.start()
    inside.wait(10)
    threading.Timer(0.2, leave.set).start()
    with graph_module.environment_of({"CSAS_TEST_KEPT": "mine", "CSAS_TEST_NEW": "mine"}):
        assert os.environ["CSAS_TEST_NEW"] == "mine"
    thread.join()
    assert os.environ["CSAS_TEST_KEPT"] == "before"
    assert "CSAS_TEST_NEW" not in os.environ


@pytest.mark.parametrize("forked", [False, True])
def test_a_node_killed_in_its_first_moment_leaves_no_shared_memory(tmp_path: Path, forked: bool) -> None:
    before = segments()
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(DomainReservation())
        ports = {f"fastrtps_port{7400 + 250 * domain + n}" for n in range(250)}
        server = stack.enter_context(start_fork_server(domain, tmp_path)) if forked else None
        graph = stack.enter_context(Graph({"composites": {}}, domain, tmp_path, server=server))
        pid = graph.processes["composites"].pid
        deadline = time.monotonic() + 60
        while not (lost := {path.name for path in segments_of(pid)}):
            assert time.monotonic() < deadline
            time.sleep(0.001)
        os.kill(pid, signal.SIGKILL)  # before the graph has looked at all
        while not graph.deaths:
            assert time.monotonic() < deadline
            graph.watch()
            time.sleep(0.01)
        running(graph, tmp_path, "composites")
    assert lost - before
    assert not lost & segments()
    assert not {name for name in segments() if name.removeprefix("sem.").removesuffix("_mutex") in ports}


def readable(path: Path) -> bool:
    try:
        path.read_bytes()
    except OSError:
        return False
    return True


def test_a_little_shared_memory_is_left_to_the_middleware(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" in graph_environment(1, tmp_path)
    monkeypatch.setattr(graph_module, "free_shared_memory", lambda: 64 << 20)
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in graph_environment(1, tmp_path)


def test_a_node_that_dies_again_and_again_ends_the_replay_by_name(domain: int, tmp_path: Path) -> None:
    graph = Graph({"composites": {}}, domain, tmp_path, max_restarts=1)
    with graph:
        process = graph.processes["composites"]
        for _ in range(2):
            os.kill(process.pid, signal.SIGKILL)
            deadline = time.monotonic() + 10
            while process.poll() is None:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            if process.restarts < 1:
                graph.watch()
        with pytest.raises(ReplayError, match="composites died 2 times; composites was killed by signal 9"):
            graph.watch()
    assert not alive(process.pid)
