"""What a node says when it becomes active, and what a lifecycle manager may set before."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from graph_of_nodes import STEP_DEG, VOXEL_M
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter

from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import SimulatedRun
from msg_adapters import RclpyMessages, coherent_image_to_msgs, track_to_msg

if TYPE_CHECKING:
    from graph_of_nodes import Graph

MESSAGES = RclpyMessages()


def test_a_node_says_what_it_takes_and_gives_when_it_becomes_active(graph: Graph, capfd: Any) -> None:
    graph.add(SubApertureNode)
    graph.add(ShadowLikelihoodNode)
    said = [line for line in capfd.readouterr().err.splitlines() if "active" in line]
    assert len(said) == 2
    takes, gives = "image, camera_info, track, sector/*", "search, target, sub_aperture/*"
    assert said[0].endswith(f"[csas.sub_aperture]: active: takes {takes}; gives {gives}")
    assert said[1].endswith("active: takes search, target, shadow/*; gives likelihood/*")


def test_parameters_are_set_on_an_unconfigured_node_and_work_once_it_is_configured(
    graph: Graph, view_bag: Any
) -> None:
    bag = str(view_bag("shadow"))
    node = BagPlayerNode(context=graph.context, overrides={"autostart": False})
    graph.nodes.append(node)
    graph.executor.add_node(node)
    assert node.set_parameters([Parameter("bag", value=bag)])[0].successful
    refused = node.set_parameters([Parameter("window", value=99)])[0]
    assert not refused.successful
    assert "window" in refused.reason
    assert node.start(), node.error
    assert node.reader.path.samefile(bag)
    frozen = node.set_parameters([Parameter("bag", value="other")])[0]
    assert not frozen.successful
    assert frozen.reason == "bag can be set while the node is unconfigured; expected: cleanup first"
    assert node.get_parameter("bag").value == bag
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert node.set_parameters([Parameter("bag", value="other")])[0].successful
    assert not node.start()
    assert "other" in node.error


def test_parameters_that_belong_together_may_be_set_one_by_one(graph: Graph) -> None:
    node = VoxelCarverNode(context=graph.context, overrides={"autostart": False})
    graph.nodes.append(node)
    graph.executor.add_node(node)
    assert node.set_parameters([Parameter("origin_lat_deg", value=48.0)])[0].successful
    assert not node.start()
    assert "origin_lat_deg is given, origin_lon_deg is not" in node.error
    assert node.set_parameters([Parameter("origin_lon_deg", value=-4.5)])[0].successful
    assert node.start(), node.error
    assert math.isnan(node.parameters.origin_heading_deg)


def test_what_was_latched_while_a_node_was_inactive_reaches_it_once_it_is_active(
    graph: Graph, run_bag: Path
) -> None:
    """A lifecycle manager may activate the player first: nobody publishes the image a second time."""
    node = SubApertureNode(context=graph.context, overrides={"step_deg": STEP_DEG, "min_sinks": 1})
    graph.nodes.append(node)
    graph.executor.add_node(node)
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    graph.add(BagPlayerNode, bag=str(run_bag))
    came = {"image", "camera_info", "track"}
    graph.spin_until(lambda: came <= node._missed, what="all of it comes to the inactive node")
    assert node.run is None
    graph.add(VoxelCarverNode, voxel_size_m=VOXEL_M)
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    graph.spin_until(lambda: node.run is not None, what="it has the image and its track")


def test_publishers_that_are_heard_are_not_warned_of(
    graph: Graph, simulated: SimulatedRun, capfd: Any
) -> None:
    """An outside program that does not latch is heard by a second subscription: no reason for alarm."""
    context = Context()
    rclpy.init(context=context, domain_id=graph.domain_id)
    driver = rclpy.create_node("driver", context=context, namespace="csas")
    node = graph.add(SubApertureNode)
    image, info = coherent_image_to_msgs(MESSAGES, simulated.image)
    messages = {"track": track_to_msg(MESSAGES, simulated.track), "camera_info": info, "image": image}
    publishers = {name: driver.create_publisher(type(m), name, qos.UNLATCHED) for name, m in messages.items()}
    graph.spin_until(lambda: all(p.get_subscription_count() for p in publishers.values()))
    for name, publisher in publishers.items():
        publisher.publish(messages[name])
    graph.spin_until(lambda: bool(node.runs) and node.runs[0].stream.track is not None)
    driver.destroy_node()
    rclpy.shutdown(context=context)
    assert "incompatible QoS" not in capfd.readouterr().err
