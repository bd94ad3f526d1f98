"""A recorder that cannot write holds nobody up for good, and what a recording lacks is said."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, Graph

from csas_shadow_ros.bags import BagReader, BagWriter, read_run
from csas_shadow_ros.bags.bag import copy
from csas_shadow_ros.core.pipeline import ProcessedView, Result
from csas_shadow_ros.graph import replay as module
from csas_shadow_ros.graph.replay import replay
from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.bag_recorder import BagRecorderNode
from csas_shadow_ros.nodes.runtime.flow import Flow
from msg_adapters.progress import INTEGRATED, Heartbeat, ViewProgress

Reference = tuple[Result, list[ProcessedView]]


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The graphs that replays have started, the last one last."""
    started: list[Any] = []

    class Watched(module.Graph):
        def __enter__(self) -> Any:
            started.append(self)
            return super().__enter__()

    monkeypatch.setattr(module, "Graph", Watched)
    return started


def assert_same_grid(result: module.ReplayResult, reference: Reference) -> None:
    assert result.grid is not None
    assert reference[0].grid is not None
    np.testing.assert_array_equal(result.grid.likelihood, reference[0].grid.likelihood)


def test_a_replay_whose_recorder_may_write_no_more_ends_with_its_grid_and_says_what_is_not_recorded(
    run_bag: Path, reference: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Real writes that really fail, as on a full disk: the system lets this process' files grow no further.
    limit = 1 << 20
    enter = module.Graph.__enter__

    def entered(graph: Any) -> Any:
        made = enter(graph)
        resource.prlimit(graph.processes["bag_recorder"].pid, resource.RLIMIT_FSIZE, (limit, limit))
        return made

    monkeypatch.setattr(module.Graph, "__enter__", entered)
    waits = {"sink_wait_s": 2.0}
    result = replay(
        run_bag,
        tmp_path,
        PARAMETERS,
        record=True,
        composites=False,
        overrides={"sub_aperture": waits, "bag_player": waits},
        progress=False,
        stall_timeout_s=60.0,
    )
    assert_same_grid(result, reference)
    assert result.views_total == 36
    assert result.lost == 0
    assert "cannot write to" in result.not_recorded[0]
    assert any("of 36 sub_aperture views" in line for line in result.not_recorded)


@contextlib.contextmanager
def small_disk(path: Path, megabytes: int) -> Iterator[None]:
    """Mount a file system of its own, where this user may."""
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(path)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def test_a_recorder_says_that_its_disk_is_full_and_goes_on_once_there_is_room(
    graph: Graph, view_bag: Callable[[str], Path], tmp_path: Path
) -> None:
    with small_disk(tmp_path / "disk", 80):
        out, ballast = tmp_path / "disk" / "recording", tmp_path / "disk" / "others"
        ballast.write_bytes(bytes((80 - 16 << 20) - (6 << 18)))  # one view, of 1 MiB, has room
        recorder = graph.add(BagRecorderNode, out=str(out))
        player = graph.add(
            BagPlayerNode, bag=str(view_bag("likelihood")), rate=0.0, min_sinks=1, sink_wait_s=120.0
        )
        graph.spin_until(lambda: bool(recorder.unable))
        assert "disk of" in recorder.unable
        assert "MB left; expected" in recorder.unable
        graph.spin_until(lambda: not player.source.flow.live(), what="it is not counted on")
        assert not player.source.flow.finished, "but waited for"
        assert player.source.flow.done < 36
        ballast.unlink()
        graph.spin_until(lambda: not recorder.unable)
        graph.spin_until(lambda: player.source.flow.finished and player.source.flow.done == 36)
        graph.nodes.remove(recorder)
        graph.executor.remove_node(recorder)
        recorder.stop()
        recorder.destroy_node()
        recorded = read_run(out)
        assert recorded.problems == []
        assert recorded.counts["likelihood"] == 36


def test_a_sink_that_cannot_work_is_waited_for_a_while_and_the_others_go_on() -> None:
    now = [0.0]
    flow = Flow("likelihood", settle_s=0.0, sink_wait_s=60.0, clock=lambda: now[0])

    def say(name: str, **values: str) -> None:
        flow.heard(Heartbeat(1, name, f"{name}-1", "sink", values={"input": "likelihood", **values}))

    def look() -> None:
        now[0] += 0.5
        say("voxel_carver")
        say("bag_recorder", unable="the disk is full")
        flow.look()

    say("voxel_carver")
    say("bag_recorder")
    flow.offer([1, 2])
    flow.look()
    look()
    sent = []
    while (stamp := flow.next()) is not None:
        sent.append(stamp)
    for stamp in sent:
        flow.heard(ViewProgress(stamp, "voxel_carver", "voxel_carver-1", INTEGRATED, values={"role": "sink"}))
    assert sent == [1, 2]
    assert flow.done == 2
    assert not flow.finished, "it may come back and need them"
    for _ in range(122):
        look()
    assert flow.finished
    told = [text for _, text in flow.notes if "bag_recorder" in text]
    assert told[0].startswith("bag_recorder cannot take likelihood: the disk is full; waiting for it, 60 s")
    assert told[1:] == ["bag_recorder did not come back in 60 s; going on"]
    say("bag_recorder")
    flow.look()
    assert not flow.finished, "it works again, and lacks both"
    assert flow.next() == 1


def test_a_pause_longer_than_a_replay_waits_for_news_is_played_as_it_was(
    view_bag: Callable[[str], Path], reference: Reference, tmp_path: Path
) -> None:
    path, count = tmp_path / "pause", 0
    with BagWriter(path) as writer:
        for message in BagReader(view_bag("sub_aperture")).messages():
            count += 1
            when = (count > 30) * 24 * 10**9
            writer.write(message.topic, message.cdr, when, type_name=message.type_name)
    result = replay(path, tmp_path / "out", PARAMETERS, rate=1.0, progress=False, stall_timeout_s=15.0)
    assert result.views_used == 36
    assert result.lost == 0


def test_what_a_recording_lacks_is_named(run_bag: Path, tmp_path: Path) -> None:
    result = replay(run_bag, tmp_path, PARAMETERS, record=True, composites=False, progress=False)
    assert result.not_recorded == []
    recording = tmp_path / "recording"
    lost = {"/csas/image", "/csas/measurements"}
    stamps: list[int] = []

    def keep(message: Any) -> bool:
        if message.topic == "/csas/shadow/image":
            stamps.append(message.number)
            return len(stamps) > 3
        return message.topic not in lost

    with BagWriter(tmp_path / "cut") as writer:
        copy(BagReader(recording), writer, keep)
    published = ["sub_aperture", "shadow"]
    messages = {"measurements", "objects"}

    def lacking(path: Path, topics: str = "all") -> list[str]:
        return module._not_recorded(path, topics, result, published, messages)

    assert lacking(recording) == []
    assert lacking(tmp_path / "cut") == ["nothing of image, measurements", "33 of 36 shadow views"]
    assert lacking(tmp_path / "cut", "track,objects") == []
    assert "there is no bag at" in lacking(tmp_path / "nowhere")[0]


@pytest.mark.parametrize(
    "victim",
    [
        "voxel_carver",
        "composites",
        pytest.param("sub_aperture", marks=pytest.mark.long),
        pytest.param("bag_recorder", marks=pytest.mark.long),
    ],
)
def test_a_node_killed_between_the_last_view_and_the_collection_of_the_result_costs_nothing(
    run_bag: Path,
    reference: Reference,
    tmp_path: Path,
    graphs: list[Any],
    monkeypatch: pytest.MonkeyPatch,
    victim: str,
) -> None:
    collect = module._collect
    deaths: list[str] = []

    def killed_before(graph: Any, *more: Any) -> Any:
        os.kill(graph.processes[victim].pid, signal.SIGKILL)
        return collect(graph, *more)

    monkeypatch.setattr(module, "_collect", killed_before)
    result = replay(run_bag, tmp_path, PARAMETERS, record=True, progress=False, notice=deaths.append)
    assert graphs[-1].deaths[0].startswith(f"{victim} was killed by signal 9")
    assert deaths[0].startswith(f"{victim} was killed by signal 9")
    assert_same_grid(result, reference)
    assert result.composites["multilook"].any()
    assert result.lost == 0
    assert result.not_recorded == []


def test_a_replay_waits_until_its_recording_holds_what_is_said_once(
    run_bag: Path, tmp_path: Path, graphs: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The middleware may bring a latched message seconds after views, if it lost a part of it."""
    collect = module._collect
    waited: list[set[str]] = []

    def late(graph: Any, watcher: Any, *more: Any) -> Any:
        began = time.monotonic()
        real = module._not_held

        def not_held(*args: Any) -> set[str]:
            # What the recorder says is held back for a second, and then let through.
            if time.monotonic() - began < 1.0:
                for key, beat in watcher.beats.items():
                    if key[0] == "bag_recorder":
                        holds = set(beat.values["holds"].split()) - {"camera_info"}
                        watcher.beats[key] = replace(
                            beat, values={**beat.values, "holds": " ".join(sorted(holds))}
                        )
            waited.append(real(*args))
            return waited[-1]

        monkeypatch.setattr(module, "_not_held", not_held)
        return collect(graph, watcher, *more)

    monkeypatch.setattr(module, "_collect", late)
    result = replay(run_bag, tmp_path, PARAMETERS, record=True, composites=False, progress=False)
    assert {"camera_info"} in waited
    assert waited[-1] == set()
    assert result.not_recorded == []
