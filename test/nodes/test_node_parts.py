"""Parts of the nodes: parameters, slow and absent consumers, rubbish on the wire, playing and launching."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")

from graph_of_nodes import Graph

from csas_shadow_ros.bags import BagReader, write_run
from csas_shadow_ros.core.errors import BagError, ParameterError
from csas_shadow_ros.core.pipeline import ProcessedView, Result
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.composites import CompositesNode
from csas_shadow_ros.nodes.playing import BagViews, header_stamp, schedule, stage_of_bag
from csas_shadow_ros.nodes.runtime import params
from csas_shadow_ros.nodes.runtime.base import INTEGRATED, CsasNode, Inlet, Source, spin
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import SimulatedRun
from msg_adapters import RclpyMessages, RosbagsMessages, coherent_image_to_msgs, stamp_to_ns, track_to_msg

ROOT = Path(__file__).resolve().parents[2]
NODES = {
    n.name: n for n in (SubApertureNode, ShadowLikelihoodNode, VoxelCarverNode, CompositesNode, BagPlayerNode)
}


# Parameters


def test_the_yaml_file_is_what_the_dataclasses_say() -> None:
    text = (ROOT / "config" / "csas_shadow.yaml").read_text(encoding="utf-8")
    assert text == params.yaml_text(), "run: python -m csas_shadow_ros.nodes.runtime.params --yaml > config/…"


def test_the_yaml_file_reads_back_to_the_defaults() -> None:
    document = yaml.safe_load((ROOT / "config" / "csas_shadow.yaml").read_text(encoding="utf-8"))
    assert {k.removeprefix("/**/") for k in document} == set(params.NODES)
    for key, section in document.items():
        kind = params.NODES[key.removeprefix("/**/")]
        assert kind.from_mapping(section["ros__parameters"]) == kind()


def test_the_table_names_every_parameter_of_every_node_with_its_default() -> None:
    table = params.parameter_table()
    for name, kind in params.NODES.items():
        section = table.split(f"**{name}**", 1)[1].split("\n**", 1)[0]
        for field in fields(kind):
            row = next(line for line in section.splitlines() if line.startswith(f"| `{field.name}` |"))
            assert field.metadata["doc"] in row
            assert params.expected_of(field) in row


@pytest.mark.parametrize("name", list(NODES))
def test_descriptors_say_the_bounds_of_the_dataclasses(graph: Graph, name: str) -> None:
    node = NODES[name](context=graph.context)
    try:
        for field in fields(params.NODES[name]):
            descriptor = node.describe_parameter(field.name)
            meta = field.metadata
            assert meta["doc"] in descriptor.description
            fixed = "set while the node is unconfigured" in descriptor.additional_constraints
            assert fixed == (field.name not in params.DYNAMIC)
            ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
            is_number = isinstance(field.default, int | float) and not isinstance(field.default, bool)
            # rclpy finds NaN, which says that nothing is given, to be out of any range.
            assert bool(ranges) == (is_number and not meta["optional"])
            if ranges:
                assert (ranges[0].from_value, ranges[0].to_value) == (meta["low"], meta["high"])
    finally:
        node.destroy_node()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"voxel_size_m": 0.0}, r"voxel_size_m is 0.0 m; expected a number in \[0.0001, 1000\] m"),
        ({"voxel_size_m": float("nan")}, "voxel_size_m is nan"),
        ({"method": "medium"}, "method is 'medium'; expected one of"),
        ({"publish_hz": "often"}, "publish_hz is 'often'; expected a number"),
        ({"position_m": [1.0]}, r"position_m is \[1.0\]; expected 2 numbers"),
        ({"voxel_sise_m": 0.1}, "unknown parameter 'voxel_sise_m'"),
    ],
)
def test_a_parameter_that_is_out_of_range_or_unknown_is_refused_at_start(
    graph: Graph, overrides: dict[str, Any], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        VoxelCarverNode(context=graph.context, overrides=overrides)


def test_whole_numbers_are_taken_where_numbers_are_expected(graph: Graph) -> None:
    node = VoxelCarverNode(context=graph.context, overrides={"voxel_size_m": 1, "position_m": [1, 2]})
    assert node.get_parameter("voxel_size_m").value == 1.0
    assert node.parameters.position_m == (1.0, 2.0)
    node.destroy_node()


def test_setting_a_parameter_out_of_range_is_refused_and_in_range_takes_effect(graph: Graph) -> None:
    from rclpy.parameter import Parameter

    node = graph.add(BagPlayerNodeOfNothing)
    refused = node.set_parameters([Parameter("window", value=99)])[0]
    assert not refused.successful
    assert "window" in refused.reason
    assert node.parameters.window == 4
    assert node.set_parameters([Parameter("window", value=2)])[0].successful
    assert node.source.flow.window == 2
    frozen = node.set_parameters([Parameter("bag", value="other")])[0]
    assert not frozen.successful, "such a parameter cannot change in mid-run"


def test_a_given_target_needs_its_size(graph: Graph) -> None:
    node = VoxelCarverNode(context=graph.context, overrides={"target": "given"})
    try:
        assert not node.start()
        assert "size_m is [0.0, 0.0, 0.0]" in node.error
    finally:
        node.destroy_node()


# Sources and sinks of large messages


class BagPlayerNodeOfNothing(CsasNode):
    """A source of large made-up views."""

    name = "bag_player"
    count, pixels = 100, np.zeros(1, np.float32)

    def setup(self) -> None:
        self.pixels = np.full((512, 512), 0.5, np.float32)
        self.source = Source(self, "shadow", self.send)
        self.source.flow.offer(range(1, self.count + 1))
        self.most = 0

    def send(self, stamp: int) -> None:
        from msg_adapters.messages import make_header

        self.most = max(self.most, self.source.flow.in_flight)
        header = make_header(self.messages, stamp)
        octets = self.messages.octets(self.pixels)
        image = self.messages.make(
            "sensor_msgs/msg/Image",
            header=header,
            height=512,
            width=512,
            encoding="32FC1",
            step=2048,
            data=octets,
        )
        self.source.info.publish(self.messages.make("sensor_msgs/msg/CameraInfo", header=header))
        self.source.image.publish(image)


class SlowSink(CsasNode):
    """A sink that takes its time."""

    name = "composites"
    pause_s = 0.02

    def setup(self) -> None:
        self.received: list[int] = []
        self.inlet = Inlet(self, "shadow", "sink", self.work)

    def work(self, image: Any, info: Any) -> str:
        time.sleep(self.pause_s)  # the work of a slow consumer
        self.received.append(image.header.stamp.nanosec)
        return INTEGRATED


def test_a_slow_sink_gets_every_large_view_and_few_are_ever_on_their_way(graph: Graph) -> None:
    sink = graph.add(SlowSink)
    source = graph.add(BagPlayerNodeOfNothing)
    graph.spin_until(lambda: source.source.flow.finished)
    assert sorted(set(sink.received)) == list(range(1, 101))
    assert source.most <= 4
    assert source.source.flow.resends == 0
    assert source.counts["sent"] == 100


def test_without_any_consumer_the_source_ends_and_one_that_comes_late_gets_everything(graph: Graph) -> None:
    source = graph.add(BagPlayerNodeOfNothing, sink_wait_s=0.3)
    graph.spin_until(lambda: source.source.flow.finished)
    assert source.counts["sent"] == 0
    sink = graph.add(SlowSink)
    graph.spin_until(lambda: len(set(sink.received)) == 100)


def test_a_subscriber_that_reports_nothing_gets_every_view(graph: Graph) -> None:
    got: list[int] = []
    viewer = graph.plain_node("viewer")
    viewer.create_subscription(
        RclpyMessages().cls("sensor_msgs/msg/Image"),
        "shadow/image",
        lambda m: got.append(m.header.stamp.nanosec),
        qos.VIEWS,
    )
    source = graph.add(BagPlayerNodeOfNothing)
    graph.spin_until(lambda: source.source.flow.finished)
    graph.spin_until(lambda: len(got) == 100)
    assert got == list(range(1, 101))


def test_rubbish_on_the_wire_does_not_end_a_node(graph: Graph) -> None:
    """Bytes that are no message of the type: taking them fails inside the executor."""
    sink = SlowSink(context=graph.context)
    assert sink.start()
    stop = threading.Event()
    thread = threading.Thread(target=spin, args=(sink, stop))
    thread.start()
    try:
        outside = graph.plain_node("outside")
        publisher = outside.create_publisher(
            RclpyMessages().cls("sensor_msgs/msg/Image"), "shadow/image", qos.VIEWS
        )
        graph.spin_until(lambda: publisher.get_subscription_count() > 0)
        publisher.publish(b"\x00\x01\x00\x00" + b"\xff" * 40)
        source = graph.add(BagPlayerNodeOfNothing)
        graph.spin_until(lambda: source.source.flow.finished)
        assert sorted(set(sink.received)) == list(range(1, 101))
        assert thread.is_alive()
    finally:
        stop.set()
        thread.join()
        sink.stop()
        sink.destroy_node()


# Playing


class Listener(CompositesNode):
    """Takes targets, which it knows by their stamps."""

    def setup(self) -> None:
        self.forget()
        self.heard: list[int] = []
        self.subscribe_latched("target", lambda msg: self.heard.append(msg.header.stamp.sec))

    def tick(self) -> None:
        """Nothing is published."""


def test_what_is_latched_comes_once_and_what_is_not_latched_comes_too(graph: Graph) -> None:
    node = graph.add(Listener)
    outside, messages = graph.plain_node("outside"), RclpyMessages()
    kind = messages.cls("visualization_msgs/msg/Marker")
    there = lambda count: lambda: outside.count_subscribers("target") == count  # noqa: E731
    graph.spin_until(there(2), what="both subscriptions, as nobody publishes")

    def publish(publisher: Any, second: int) -> None:
        message = kind()
        message.header.stamp.sec = second
        publisher.publish(message)
        graph.spin_until(lambda: second in node.heard)
        end = time.monotonic() + 0.5
        graph.spin_until(lambda: time.monotonic() > end)

    latching = outside.create_publisher(kind, "target", qos.LATCHED)
    graph.spin_until(there(1), what="the second subscription is taken back")
    publish(latching, 1)
    forgetful = outside.create_publisher(kind, "target", qos.UNLATCHED)
    graph.spin_until(there(2), what="somebody does not latch")
    graph.spin_until(lambda: forgetful.get_subscription_count() == 1)
    publish(forgetful, 2)
    outside.destroy_publisher(forgetful)
    graph.spin_until(there(1), what="only who latches is left")
    publish(latching, 3)
    assert node.heard == [1, 2, 3]
    outside.destroy_publisher(latching)
    graph.spin_until(there(2), what="whoever comes next may not latch")


def test_a_pair_of_a_bag_can_be_had_again_in_any_order(view_bag: Callable[[str], Path]) -> None:
    views = BagViews(BagReader(view_bag("likelihood")), "likelihood")
    stamps = list(views.times)
    assert len(stamps) == 36
    order = [*stamps, stamps[3], stamps[35], stamps[0], *stamps[:5]]
    for stamp in order:
        image, info = views.get(stamp)
        assert header_stamp(image, "image") == header_stamp(info, "info") == stamp
    assert len(views._recent) <= 16
    with pytest.raises(BagError, match="holds no image stamped 12345 ns"):
        views.get(12345)


def test_the_stage_of_a_bag_is_the_earliest_that_it_holds_whole(
    run_bag: Path, view_bag: Callable[[str], Path]
) -> None:
    assert stage_of_bag(BagReader(run_bag)) == "image"
    assert stage_of_bag(BagReader(view_bag("shadow"))) == "shadow"
    with pytest.raises(BagError, match="holds no likelihood; it holds: image"):
        stage_of_bag(BagReader(run_bag), "likelihood")


@pytest.mark.parametrize(
    "cdr", [b"", b"\x00\x01\x00\x00abc", b"\x07" * 20, b"\x00\x01\x00\x00" + b"\xff" * 8]
)
def test_a_message_without_a_legible_stamp_is_refused(cdr: bytes) -> None:
    with pytest.raises(BagError, match="x: "):
        header_stamp(cdr, "x")


def test_a_player_keeps_to_the_rate(
    graph: Graph, view_bag: Callable[[str], Path], reference: tuple[Result, list[ProcessedView]]
) -> None:
    stamps = [v.likelihood.info.stamp_ns for v in reference[1]]
    recorded_s = (max(stamps) - min(stamps)) / 1e9
    got: list[float] = []
    viewer = graph.plain_node("viewer")
    viewer.create_subscription(
        RclpyMessages().cls("sensor_msgs/msg/Image"),
        "likelihood/image",
        lambda m: got.append(time.monotonic()),
        qos.VIEWS,
    )
    graph.add(BagPlayerNode, bag=str(view_bag("likelihood")), rate=recorded_s / 2.0)  # in two seconds
    graph.spin_until(lambda: len(got) == 36)
    assert 1.6 < got[-1] - got[0] < 6.0


@pytest.mark.parametrize(("bag", "message"), [("", "bag is ''"), ("/nowhere", "there is no bag at /nowhere")])
def test_a_player_without_a_bag_refuses_to_start(graph: Graph, bag: str, message: str) -> None:
    node = BagPlayerNode(context=graph.context, overrides={"bag": bag})
    try:
        assert not node.start()
        assert message in node.error
    finally:
        node.destroy_node()


def test_diagnostics_say_how_far_each_node_is_and_what_it_waits_for(graph: Graph) -> None:
    got: dict[str, Any] = {}
    viewer = graph.plain_node("viewer")
    viewer.create_subscription(
        RclpyMessages().cls("diagnostic_msgs/msg/DiagnosticArray"),
        "/diagnostics",
        lambda m: got.__setitem__(m.status[0].name, m.status[0]),
        qos.DIAGNOSTICS,
    )
    graph.add(SubApertureNode)
    graph.spin_until(lambda: "/csas/sub_aperture" in got)
    status = got["/csas/sub_aperture"]
    assert status.message == "waiting for image and track"
    keys = {v.key for v in status.values}
    assert {"busy seconds", "sectors", "sub_aperture total"} <= keys


# Files that other tools read


def test_the_layouts_show_topics_of_the_contract() -> None:
    from msg_adapters import TOPICS

    known = {t if t.startswith("/") else f"/csas/{t}" for t in TOPICS}
    rviz = yaml.safe_load((ROOT / "config" / "csas_shadow.rviz").read_text(encoding="utf-8"))
    shown = [d["Topic"]["Value"] for d in rviz["Visualization Manager"]["Displays"] if "Topic" in d]
    assert len(shown) >= 4
    assert set(shown) <= known
    layout = json.loads((ROOT / "config" / "foxglove_layout.json").read_text(encoding="utf-8"))
    panels = set(layout["configById"])

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert set(leaves(layout["layout"])) == panels
    text = json.dumps(layout["configById"])
    for topic in ("/csas/mesh", "/csas/voxels", "/csas/shadow/display"):
        assert topic in text
        assert topic in known


def test_a_clock_that_was_set_or_a_pause_of_hours_holds_up_no_playing_and_is_told() -> None:
    second = 10**9
    years = 54 * 365 * 86400 * second
    for times, expected, told in (
        ({1: 0, 2: second, 3: 3 * second}, [0.0, 1.0, 3.0], 0),
        ({1: 0, 2: 300 * second, 3: 301 * second}, [0.0, 300.0, 301.0], 0),  # a pause is kept
        ({1: 0, 2: years, 3: years + second, 4: years + 2 * second}, [0.0, 1.0, 2.0, 3.0], 1),
        ({1: years, 2: years + second, 3: 0, 4: second}, [0.0, 1.0, 2.0, 3.0], 1),
        ({1: 7, 2: years}, [0.0, 0.0], 1),
        ({}, [], 0),
    ):
        seconds, notes = schedule(times)
        assert list(seconds) == list(times)
        assert list(seconds.values()) == expected
        assert len(notes) == told


def test_a_player_plays_the_run_of_the_namespace_that_it_is_told(
    graph: Graph, simulated: SimulatedRun, tmp_path: Path
) -> None:
    factory = RosbagsMessages()
    image, info = coherent_image_to_msgs(factory, simulated.image)
    late = replace(simulated.image, stamp_ns=int(simulated.track.stamps_ns[-2]))
    other, other_info = coherent_image_to_msgs(factory, late)
    path = track_to_msg(factory, simulated.track)
    two = [("/port/image", image), ("/port/camera_info", info), ("/port/track", path)]
    two += [("/starboard/image", other), ("/starboard/camera_info", other_info), ("/starboard/track", path)]
    bag = write_run(tmp_path / "two", None, None, extra=two)
    node = BagPlayerNode(context=graph.context, overrides={"bag": str(bag)})
    assert not node.start()
    assert "holds topics of /port and of /starboard" in node.error
    node.destroy_node()
    taken: list[int] = []
    graph.plain_node("listener").create_subscription(
        RclpyMessages().cls("sensor_msgs/msg/CameraInfo"),
        "camera_info",
        lambda msg: taken.append(stamp_to_ns(msg.header.stamp)),
        qos.LATCHED,
    )
    graph.add(BagPlayerNode, bag=str(bag), bag_namespace="starboard")
    graph.spin_until(lambda: bool(taken))
    assert taken == [late.stamp_ns]
