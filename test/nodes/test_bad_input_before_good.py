"""What cannot be used is refused, and a run that comes after it is made all the same."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import Graph

from csas_shadow_ros.core.geometry import CoherentImage, Track
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.simulation import SimulatedRun
from msg_adapters import coherent_image_to_msgs, track_to_msg
from msg_adapters.messages import RclpyMessages

STEP_DEG = 10.0


class Outside:
    """Somebody else's program that publishes a run."""

    def __init__(self, graph: Graph) -> None:
        self.messages = RclpyMessages()
        node = graph.plain_node("outside")
        kinds = {"image": "sensor_msgs/msg/Image", "camera_info": "sensor_msgs/msg/CameraInfo"}
        kinds["track"] = "nav_msgs/msg/Path"
        self.publishers = {
            topic: node.create_publisher(self.messages.cls(kind), topic, qos.LATCHED)
            for topic, kind in kinds.items()
        }
        graph.spin_until(lambda: all(p.get_subscription_count() for p in self.publishers.values()))

    def image(self, image: CoherentImage, *, stamped: bool = True) -> None:
        picture, info = coherent_image_to_msgs(self.messages, image)
        if not stamped:
            for header in (picture.header, info.header):
                header.stamp.sec = header.stamp.nanosec = 0
        self.publishers["image"].publish(picture)
        self.publishers["camera_info"].publish(info)

    def track(self, track: Track) -> None:
        self.publishers["track"].publish(track_to_msg(self.messages, track))


def has_views(node: Any) -> bool:
    return node.source.flow.total == 36


def test_a_track_too_sparse_for_any_view_is_refused_and_the_next_one_used(
    graph: Graph, simulated: SimulatedRun
) -> None:
    node = graph.add(SubApertureNode, step_deg=STEP_DEG)
    outside = Outside(graph)
    track = simulated.track
    every = np.arange(len(track) - 1, 0, -20)[::-1]
    outside.image(simulated.image)
    outside.track(Track(track.stamps_ns[every], track.positions_m[every]))
    graph.spin_until(lambda: any("covers 0.0 of 360" in r for r in node.examples.values()))
    assert node.source.flow.total == 0
    outside.track(track)
    graph.spin_until(lambda: has_views(node))


def test_an_image_that_contradicts_its_own_spectrum_is_refused_and_the_next_one_used(
    graph: Graph, simulated: SimulatedRun
) -> None:
    node = graph.add(SubApertureNode, step_deg=STEP_DEG)
    outside = Outside(graph)
    acoustics = simulated.image.acoustics
    kilohertz = replace(
        acoustics,
        centre_frequency_hz=acoustics.centre_frequency_hz / 1e3,
        bandwidth_hz=acoustics.bandwidth_hz / 1e3,
    )
    outside.track(simulated.track)
    outside.image(replace(simulated.image, acoustics=kilohertz, stamp_ns=int(simulated.track.stamps_ns[-5])))
    graph.spin_until(lambda: bool(node.error))
    assert "energy" in node.error
    outside.image(simulated.image)
    graph.spin_until(lambda: has_views(node))
    assert not node.error


def test_an_image_that_nobody_stamped_is_refused_at_once_and_the_next_one_used(
    graph: Graph, simulated: SimulatedRun
) -> None:
    node = graph.add(SubApertureNode, step_deg=STEP_DEG)
    outside = Outside(graph)
    track = simulated.track
    # In simulated time the track begins at 0, and would cover that stamp.
    outside.track(Track(track.stamps_ns - track.stamps_ns[0], track.positions_m))
    outside.image(simulated.image, stamped=False)
    graph.spin_until(lambda: any("header.stamp is 0; expected" in r for r in node.examples.values()))
    outside.image(replace(simulated.image, stamp_ns=int(track.stamps_ns[-1] - track.stamps_ns[0])))
    graph.spin_until(lambda: has_views(node))


def test_an_image_with_a_stuck_pixel_is_refused_and_one_with_a_lesser_told_of(
    graph: Graph, simulated: SimulatedRun
) -> None:
    node = graph.add(SubApertureNode, step_deg=STEP_DEG)
    outside = Outside(graph)
    outside.track(simulated.track)
    for level_db, back in ((60.0, 5), (42.0, 1)):
        pixels = simulated.image.pixels.copy()
        pixels[100, 120] = np.median(np.abs(pixels)) * 10 ** (level_db / 20)
        outside.image(replace(simulated.image, pixels=pixels, stamp_ns=int(simulated.track.stamps_ns[-back])))
        if level_db == 60.0:
            graph.spin_until(lambda: "row 100, column 120 is 60 dB" in node.error)
    graph.spin_until(lambda: has_views(node))
    assert not node.error
    assert any("row 100, column 120 is 42 dB" in kind for kind in node._logged)
