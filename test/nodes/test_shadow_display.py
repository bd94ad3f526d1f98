"""The picture of the shadow views for tools that cannot show the raw ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import Graph

from csas_shadow_ros.core.imaging.display import decibel_picture
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.playing import topics_to_record
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from msg_adapters import TOPICS, RclpyMessages, stamp_to_ns, view_to_msgs


def test_a_picture_of_each_shadow_view_is_published_to_those_who_look(
    graph: Graph, reference: Any, simulated: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from csas_shadow_ros.nodes import shadow_enhancement

    made: list[int] = []
    monkeypatch.setattr(shadow_enhancement, "decibel_picture", lambda p: made.append(1) or decibel_picture(p))
    target = reference[0].target
    node = graph.add(ShadowEnhancementNode, target="given", position_m=tuple(target.position_m))
    messages, outside = RclpyMessages(), graph.plain_node("outside")
    pair = [
        outside.create_publisher(messages.cls(TOPICS[name].type_name), name, qos.VIEWS)
        for name in ("sub_aperture/image", "sub_aperture/camera_info")
    ]
    graph.spin_until(lambda: all(p.get_subscription_count() for p in pair), what="the node is found")

    def send(view: Any) -> None:
        before = node.counts["out"]
        for publisher, message in zip(
            pair, view_to_msgs(messages, view.sub_aperture, "sub_aperture"), strict=True
        ):
            publisher.publish(message)
        graph.spin_until(lambda: node.counts["out"] == before + 1, what="the view is enhanced")

    first, second = reference[1][:2]
    send(first)
    assert not made, "nobody looks: nothing is made"
    shown: list[Any] = []
    outside.create_subscription(
        messages.cls(TOPICS["shadow/display"].type_name), "shadow/display", shown.append, 1
    )
    graph.spin_until(lambda: node.count_subscribers("shadow/display") > 0, what="somebody looks")
    graph.spin_until(lambda: node.display.get_subscription_count() > 0, what="they are matched")
    send(second)
    graph.spin_until(lambda: bool(shown), what="the picture comes")
    (picture,) = shown
    assert picture.encoding in TOPICS["shadow/display"].encodings
    assert stamp_to_ns(picture.header.stamp) == second.shadow.info.stamp_ns
    pixels = np.frombuffer(picture.data, np.uint8).reshape(picture.height, picture.width)
    np.testing.assert_array_equal(pixels, decibel_picture(second.shadow.pixels))


def test_a_recorder_of_all_topics_does_not_look_at_pictures_unless_it_is_told() -> None:
    assert "shadow/display" not in topics_to_record("all")
    assert set(topics_to_record("all")) == set(TOPICS) - {"shadow/display"}
    assert topics_to_record("shadow/display") == ["shadow/display"]
