"""A node names publishers of its topics that it cannot hear, and takes best effort where it can."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy")

import rclpy
from graph_of_nodes import Graph
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from csas_shadow_ros.core.geometry import Track
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.simulation import SimulatedRun
from msg_adapters import coherent_image_to_msgs, track_to_msg
from msg_adapters.messages import RclpyMessages

MESSAGES = RclpyMessages()
IMAGE, PATH, ODOMETRY = "sensor_msgs/msg/Image", "nav_msgs/msg/Path", "nav_msgs/msg/Odometry"
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def driver(graph: Graph) -> Iterator[Node]:
    """Make a node of another process, as far as the middleware knows: one has one type a topic."""
    context = Context()
    rclpy.init(context=context, domain_id=graph.domain_id)
    node = rclpy.create_node("driver", context=context, namespace="csas")
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("topic", "kind", "profile", "text"),
    [
        (
            "track",
            ODOMETRY,
            qos.LATCHED,
            "/csas/track: /csas/driver publishes nav_msgs/msg/Odometry; expected"
            " nav_msgs/msg/Path",
        ),
        (
            "sector/image",
            IMAGE,
            SENSOR,
            "/csas/sector/image: /csas/driver publishes sensor_msgs/msg/Image best effort;"
            " expected reliable",
        ),
        (
            "progress",
            "diagnostic_msgs/msg/DiagnosticArray",
            qos.VIEWS,
            "/csas/progress: /csas/driver publishes diagnostic_msgs/msg/DiagnosticArray volatile;"
            " expected transient local",
        ),
    ],
    ids=["another type", "best effort", "volatile"],
)
def test_a_publisher_that_cannot_be_heard_is_told_as_long_as_it_is_there(
    graph: Graph, driver: Node, topic: str, kind: str, profile: QoSProfile, text: str
) -> None:
    node = graph.add(SubApertureNode)
    watcher, found = graph.plain_node("watcher"), []
    watcher.create_subscription(
        MESSAGES.cls("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", found.append, qos.DIAGNOSTICS
    )
    publisher = driver.create_publisher(MESSAGES.cls(kind), topic, profile)
    graph.spin_until(lambda: list(node.strangers.unheard.values()) == [text], what=text)
    graph.spin_until(lambda: bool(found) and found[-1].status[0].message.startswith(text))
    (status,) = found[-1].status
    assert status.level == b"\x01"
    assert status.message == f"{text}; waiting for image and track"
    assert {v.key: v.value for v in status.values}["not heard 1"] == text
    driver.destroy_publisher(publisher)
    graph.spin_until(lambda: not node.strangers.unheard)


def test_nothing_is_said_of_publishers_that_are_heard(graph: Graph) -> None:
    node = graph.add(SubApertureNode)
    graph.add(ShadowEnhancementNode)
    driver = graph.plain_node("driver")
    for profile in (qos.LATCHED, qos.UNLATCHED, SENSOR):
        driver.create_publisher(MESSAGES.cls(PATH), "track", profile)
    asked = node.strangers._asked
    graph.spin_until(lambda: asked.get("/csas/track", (0, 0))[0] == 3)
    assert node.strangers.unheard == {}


def test_image_and_track_are_taken_from_a_best_effort_publisher(
    graph: Graph, simulated: SimulatedRun
) -> None:
    node = graph.add(SubApertureNode, step_deg=10.0)
    driver = graph.plain_node("driver")
    kinds = {"image": IMAGE, "camera_info": "sensor_msgs/msg/CameraInfo", "track": PATH}
    publishers = {t: driver.create_publisher(MESSAGES.cls(k), t, SENSOR) for t, k in kinds.items()}
    graph.spin_until(lambda: all(p.get_subscription_count() for p in publishers.values()))
    track: Track = simulated.track
    picture, info = coherent_image_to_msgs(MESSAGES, simulated.image)
    path = track_to_msg(MESSAGES, track)
    for _ in range(20):  # what is lost on the way is not sent again: a driver goes on publishing
        for topic, message in (("track", path), ("camera_info", info), ("image", picture)):
            publishers[topic].publish(message)
        for _ in range(20):
            graph.executor.spin_once(timeout_sec=0.05)
        if node.source.flow.total == 36:
            break
    assert node.source.flow.total == 36
    assert node.strangers.unheard == {}
