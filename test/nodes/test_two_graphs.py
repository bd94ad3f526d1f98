"""Two graphs at once: each replay has a domain of its own, and whoever hears another's nodes refuses them."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, STEP_DEG, VOXEL_M, Graph

import csas_shadow_ros
from csas_shadow_ros.bags import BagReader, BagWriter, write_run
from csas_shadow_ros.core.errors import BagError
from csas_shadow_ros.core.pipeline import ProcessedView, Result, run
from csas_shadow_ros.graph.processes import DomainReservation, ReplayError
from csas_shadow_ros.graph.replay import _Watcher, replay
from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.bag_recorder import BagRecorderNode
from csas_shadow_ros.nodes.runtime.rivals import Rivals
from csas_shadow_ros.nodes.runtime.shared_memory import unused
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import simulate
from msg_adapters.progress import GRAPH_ID, Heartbeat, instance_of

Reference = tuple[Result, list[ProcessedView]]


def test_the_same_draw_of_random_numbers_leaves_each_a_domain_of_its_own() -> None:
    taken = []
    for _ in range(4):
        random.seed(1)
        taken.append(DomainReservation())
    try:
        assert len({one.domain_id for one in taken}) == 4
        with pytest.raises(ReplayError, match=f"ROS domain {taken[0].domain_id} is held by another replay"):
            DomainReservation(taken[0].domain_id)
    finally:
        for one in taken:
            one.close()
    with DomainReservation(taken[0].domain_id) as again:
        assert again == taken[0].domain_id


def test_a_domain_in_which_a_participant_of_this_machine_runs_is_not_taken(graph: Graph) -> None:
    graph.plain_node("somebody")
    graph._domain.close()  # as of a graph that nobody reserved a domain for
    assert not unused(graph.domain_id)
    state = random.getstate()
    for seed in range(1000):
        random.seed(seed)
        if random.sample(range(1, 102), 101)[0] == graph.domain_id:
            random.seed(seed)
            break
    with DomainReservation() as taken:
        assert taken != graph.domain_id
    random.setstate(state)


def test_two_replays_at_once_with_one_draw_leave_each_its_own_bags_grid(
    run_bag: Path, reference: Reference, tmp_path: Path
) -> None:
    other = simulate("tiny", "cone", seed=7)
    bags = [run_bag, write_run(tmp_path / "cone", other.image, other.track)]
    expected = [reference[0], run(other.image, other.track, PARAMETERS)]
    code = "import random, sys; random.seed(1); from csas_shadow_ros.cli import main; sys.exit(main())"
    options = ["--step-deg", str(STEP_DEG), "--voxel-size-m", str(VOXEL_M), "--no-figures", "--no-bag", "-q"]
    environment = {**os.environ, "PYTHONPATH": str(Path(csas_shadow_ros.__file__).parents[1])}
    replays = [
        subprocess.Popen(
            [sys.executable, "-c", code, "replay", str(bag), "--out", str(tmp_path / f"out_{i}"), *options],
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i, bag in enumerate(bags)
    ]
    said = [process.communicate(timeout=300)[1] for process in replays]
    assert [process.returncode for process in replays] == [0, 0], said
    for i, result in enumerate(expected):
        assert result.grid is not None
        found = np.load(tmp_path / f"out_{i}" / "grid.npz")
        np.testing.assert_array_equal(found["likelihood"], result.grid.likelihood)


def test_a_replay_of_a_bag_of_two_runs_plays_the_one_whose_namespace_it_is_told(
    run_bag: Path, reference: Reference, tmp_path: Path
) -> None:
    two = tmp_path / "two"
    cone = simulate("tiny", "cone", seed=7)
    other = write_run(tmp_path / "cone", cone.image, cone.track)
    with BagWriter(two) as writer:
        for bag, namespace in ((other, "/port"), (run_bag, "/starboard")):
            for m in BagReader(bag).messages():
                topic = m.topic.replace("/csas", namespace)
                writer.write(topic, m.cdr, m.log_time_ns, type_name=m.type_name)
    with pytest.raises(BagError, match="holds topics of /port and of /starboard; expected one run: name"):
        replay(two, parameters=PARAMETERS, progress=False)
    result = replay(two, parameters=PARAMETERS, namespace="/starboard", composites=False, progress=False)
    assert result.grid is not None
    assert reference[0].grid is not None
    np.testing.assert_array_equal(result.grid.likelihood, reference[0].grid.likelihood)


def test_two_replays_into_one_domain_are_one_too_many(domain: int, run_bag: Path) -> None:
    with pytest.raises(ReplayError, match=f"ROS domain {domain} is held by another replay on this machine"):
        replay(run_bag, parameters=PARAMETERS, domain_id=domain, progress=False)


@pytest.mark.parametrize("a_node_hears_first", [False, True])
@pytest.mark.parametrize(
    ("identity", "named"),
    [("somebody", r"composites of another graph \(somebody\)"), ("", "composites that this replay did not")],
)
def test_a_replay_in_the_domain_of_a_live_graph_ends_by_name(
    graph: Graph,
    run_bag: Path,
    monkeypatch: pytest.MonkeyPatch,
    identity: str,
    named: str,
    a_node_hears_first: bool,
) -> None:
    from csas_shadow_ros.nodes.composites import CompositesNode

    on_progress = _Watcher._on_progress

    complained_s: list[float] = []

    def deaf_until_a_node_has_complained(self: _Watcher, cdr: bytes) -> None:
        on_progress(self, cdr)
        if self.errors:
            complained_s.append(time.monotonic())
        if not complained_s or time.monotonic() < complained_s[0] + 0.3:  # its next round of messages
            self.rival = ""

    if a_node_hears_first:
        monkeypatch.setattr(_Watcher, "_on_progress", deaf_until_a_node_has_complained)
    monkeypatch.setenv(GRAPH_ID, identity)
    graph.add(CompositesNode)
    graph._domain.close()
    with pytest.raises(
        ReplayError, match=rf"{named}.* is at work in ROS domain {graph.domain_id}, namespace"
    ):
        replay(run_bag, parameters=PARAMETERS, domain_id=graph.domain_id, progress=False)


def live_graph(graph: Graph, bag: Path, **more: Any) -> dict[str, Any]:
    """Start every node that turns a bag of an image into a grid."""
    return {
        "carver": graph.add(VoxelCarverNode, voxel_size_m=VOXEL_M),
        "likelihood": graph.add(ShadowLikelihoodNode),
        "enhancement": graph.add(ShadowEnhancementNode),
        "sub_aperture": graph.add(SubApertureNode, step_deg=STEP_DEG, min_sinks=1, **more),
        "player": graph.add(BagPlayerNode, bag=str(bag)),
    }


@pytest.mark.parametrize("identity", ["theirs", ""])
def test_a_live_graph_takes_and_sends_nothing_while_another_is_there_and_goes_on_after_it(
    graph: Graph,
    run_bag: Path,
    reference: Reference,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    identity: str,
) -> None:
    monkeypatch.setenv(GRAPH_ID, "ours" if identity else "")
    nodes = live_graph(graph, run_bag)
    recorder = graph.add(BagRecorderNode, out=str(tmp_path / "recording"))
    graph.spin_until(lambda: nodes["carver"].state_counts()["views"] >= 3)
    monkeypatch.setenv(GRAPH_ID, identity)
    # Another idea of the views: had these been mixed, the grid would tell.
    theirs = [graph.add(VoxelCarverNode, voxel_size_m=2 * VOXEL_M), graph.add(SubApertureNode, step_deg=5.0)]
    ours = [nodes["carver"], nodes["sub_aperture"], *([recorder] if identity else [])]
    graph.spin_until(lambda: all(node.rival for node in (*ours, *theirs)), 120.0)
    who = "of another graph (theirs)" if identity else "another "
    where = f"is at work in ROS domain {graph.domain_id}, namespace /csas"
    assert all(who in node.trouble and where in node.trouble for node in ours)
    assert theirs[0].state_counts()["views"] < 36
    for node in theirs:
        graph.nodes.remove(node)
        graph.executor.remove_node(node)
        node.stop()
        node.destroy_node()
    graph.spin_until(lambda: not any(node.rival for node in ours))
    graph.spin_until(lambda: bool(nodes["carver"].growing.complete), 120.0)
    assert nodes["carver"].reconstruction is not None
    grid = nodes["carver"].reconstruction.bodies[0].carver.grid()
    assert reference[0].grid is not None
    np.testing.assert_array_equal(grid.likelihood, reference[0].grid.likelihood)
    np.testing.assert_array_equal(grid.views, reference[0].grid.views)
    assert not nodes["sub_aperture"].source.flow.lost


BEAT = Heartbeat(1, "voxel_carver", instance_of("theirs", "1"), "sink")


class Clock:
    """Seconds that a test turns."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_who_is_heard_is_there_until_silent_for_three_seconds_or_gone_in_order() -> None:
    clock = Clock()
    rivals = Rivals("composites", alone=True, graph_id="ours", clock=clock)
    rivals.hear(replace(BEAT, instance=instance_of("ours", "1")), "")
    rivals.hear(replace(BEAT, instance="classifier-1"), "")
    assert rivals.look() == ""
    rivals.hear(BEAT, "")
    assert rivals.look() == "voxel_carver of another graph (theirs)"
    for _ in range(5):
        clock.now += 0.7
        found = rivals.look()
    assert found == ""
    rivals.hear(BEAT, "")
    assert rivals.look()
    clock.now += 10.0  # busy: what was said meanwhile has not been read yet
    assert rivals.look()
    rivals.hear(replace(BEAT, values={"leaving": "true"}), "")
    assert rivals.look() == ""


def test_the_last_words_of_a_node_that_was_killed_are_no_second_node() -> None:
    clock = Clock()
    rivals = Rivals("voxel_carver", alone=True, graph_id="ours", clock=clock)
    mine = instance_of("ours", "2")
    twin = replace(BEAT, instance=instance_of("ours", "1") + "-shadow")
    rivals.hear(replace(BEAT, instance=mine + "-shadow"), mine)
    rivals.hear(twin, mine)
    rivals.hear(twin, mine)
    assert rivals.look() == ""
    clock.now += 0.5
    rivals.hear(twin, mine)
    assert rivals.look() == "another voxel_carver"
