"""Who is told where on earth the scene is, and in which frames nodes take what comes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("rclpy")

from csas_shadow_ros.core.geometry import Datum, Origin
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import SimulatedRun
from msg_adapters import (
    RclpyMessages,
    TargetBox,
    origin_from_msg,
    origin_to_msg,
    target_to_msg,
    topic,
    track_to_msg,
)

if TYPE_CHECKING:
    from graph_of_nodes import Graph

DATUM = Datum(48.0, -4.5, covariance_m2=(4.0, 4.0, 0.0))
MESSAGES = RclpyMessages()


class Listener:
    """Somebody who comes whenever he likes."""

    def __init__(self, graph: Graph, *topics: str) -> None:
        self.node = graph.plain_node("listener")
        self.got: dict[str, Any] = {}
        for name in topics:
            kind = MESSAGES.cls(topic(name).type_name)
            self.node.create_subscription(
                kind, name, lambda msg, name=name: self.got.__setitem__(name, msg), qos.LATCHED
            )
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.tf = False
        else:
            self.tf = True
            self.node.create_subscription(
                TFMessage, "/tf_static", lambda msg: self.got.__setitem__("/tf_static", msg), qos.LATCHED
            )

    def has(self, *topics: str) -> bool:
        return {*topics, *(["/tf_static"] if self.tf else [])} <= set(self.got)


def test_a_datum_by_parameters_is_told_to_whoever_comes_late(graph: Graph) -> None:
    graph.add(
        VoxelCarverNode,
        origin_lat_deg=48.0,
        origin_lon_deg=-4.5,
        origin_sigma_m=2.0,
        scene_frame="auv_1/scene",
        parent_frame="map",
    )
    listener = Listener(graph, "origin", "scene_transform")
    graph.spin_until(lambda: listener.has("origin", "scene_transform"))
    assert origin_from_msg(listener.got["origin"]) == Origin(0, "auv_1/scene", DATUM)
    transform = listener.got["scene_transform"]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "auv_1/scene")
    assert transform.transform.rotation.w == pytest.approx(1.0)
    if listener.tf:
        assert listener.got["/tf_static"].transforms == [transform]


def test_an_origin_on_its_topic_is_passed_on_as_a_transform(graph: Graph) -> None:
    carver = graph.add(VoxelCarverNode, origin_heading_deg=90.0)
    listener = Listener(graph, "scene_transform")
    publisher = listener.node.create_publisher(MESSAGES.cls(topic("origin").type_name), "origin", qos.LATCHED)
    publisher.publish(origin_to_msg(MESSAGES, Origin(7, "contact_2", DATUM)))
    graph.spin_until(lambda: listener.has("scene_transform"))
    assert listener.got["scene_transform"].child_frame_id == "contact_2"
    datum = carver.place.publish("contact_2", None, None)
    assert datum == replace(DATUM, heading_deg=90.0)
    assert carver.place.publish("csas_scene", None, None) is None


def test_a_scene_cannot_be_its_own_parent(graph: Graph) -> None:
    node = VoxelCarverNode(context=graph.context, overrides={"parent_frame": "csas_scene"})
    assert not node.start()
    assert "parent_frame is 'csas_scene'; expected a frame other than the scene's" in node.error
    node.destroy_node()


def test_messages_of_another_frame_than_the_one_that_is_asked_for_are_refused(
    graph: Graph, simulated: SimulatedRun
) -> None:
    node = graph.add(SubApertureNode, scene_frame="auv_1/scene")
    carver = graph.add(VoxelCarverNode, scene_frame="auv_1/scene")
    other = graph.plain_node("sonar")
    path, marker = (MESSAGES.cls(topic(name).type_name) for name in ("track", "target"))
    box = TargetBox((0.0, 0.0, 0.5), (1.0, 1.0, 1.0))
    other.create_publisher(path, "track", qos.TRACK).publish(track_to_msg(MESSAGES, simulated.track))
    # The node of before publishes target, too: nobody's search goes with this one.
    other.create_publisher(marker, "target", qos.LATCHED).publish(target_to_msg(MESSAGES, box, 5))
    expected = "track.header.frame_id is 'csas_scene'; expected 'auv_1/scene'"
    graph.spin_until(lambda: any(expected in why for why in node.examples.values()))
    graph.spin_until(lambda: any(expected in why for why in carver.examples.values()))
    assert not node.track.book.names
