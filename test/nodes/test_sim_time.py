"""Nodes that go by /clock work on whatever it does: it may not be there, stand still, or jump back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import STEP_DEG, VOXEL_M, Graph
from test_graph import Reference, assert_same_grid, complete

from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.composites import CompositesNode
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.parameter_file import read_parameter_file

SIM = {"use_sim_time": True}


def clock_publisher(graph: Graph) -> Any:
    from rosgraph_msgs.msg import Clock

    publisher = graph.plain_node("clock").create_publisher(Clock, "/clock", 1)

    def tell(sec: int) -> None:
        msg = Clock()
        msg.clock.sec = sec
        publisher.publish(msg)

    return tell


@pytest.mark.parametrize("clock", ["never comes", pytest.param("jumps and stops", marks=pytest.mark.long)])
def test_a_run_comes_to_its_end_whatever_the_clock_does(
    graph: Graph, run_bag: Path, reference: Reference, clock: str
) -> None:
    carver = graph.add(VoxelCarverNode, voxel_size_m=VOXEL_M, **SIM)
    graph.add(ShadowLikelihoodNode, **SIM)
    graph.add(ShadowEnhancementNode, **SIM)
    composites = graph.add(CompositesNode, **SIM)
    source = graph.add(SubApertureNode, step_deg=STEP_DEG, min_sinks=1, **SIM)
    tell = clock_publisher(graph)
    assert carver.get_clock().ros_time_is_active
    if clock != "never comes":
        for second in (1_700_000_000, 1_700_000_100):
            tell(second)
            graph.spin_until(lambda second=second: carver.now_ns() == second * 10**9)
    graph.add(BagPlayerNode, bag=str(run_bag), **SIM)
    if clock != "never comes":
        graph.spin_until(lambda: source.source.flow.done > 5)
        tell(3)  # another bag is played from its beginning; then the player is stopped
        graph.spin_until(lambda: carver.now_ns() == 3 * 10**9)
    graph.spin_until(complete(carver))
    graph.spin_until(complete(composites))
    assert_same_grid(carver, reference)


def test_the_bag_player_publishes_the_time_of_what_it_plays(graph: Graph, view_bag: Any) -> None:
    from rosgraph_msgs.msg import Clock

    from csas_shadow_ros.bags import BagReader

    bag = view_bag("sub_aperture")
    with BagReader(bag) as reader:
        times = [m.log_time_ns for m in reader.messages(["sub_aperture/camera_info"])]
    got: list[int] = []
    listener = graph.plain_node("listener")
    listener.create_subscription(
        Clock, "/clock", lambda m: got.append(m.clock.sec * 10**9 + m.clock.nanosec), 10
    )
    follower = graph.add(CompositesNode, **SIM)
    player = graph.add(BagPlayerNode, bag=str(bag), rate=0.0, clock_hz=100.0, min_sinks=1)
    graph.spin_until(lambda: player.source.flow.finished and got[-1:] == [max(times)])
    assert got == sorted(got)
    assert got[0] >= min(times)
    assert set(got) <= set(times)  # as fast as they are taken there is no time in between
    graph.spin_until(lambda: follower.now_ns() == max(times))


def test_a_parameter_file_may_say_that_nodes_go_by_the_clock(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text("/**:\n  ros__parameters:\n    use_sim_time: true\n    step_deg: 5.0\n")
    assert read_parameter_file(file) == {"step_deg": 5.0}
