"""The graph of nodes: the same grid as in one process, whatever happens to it on the way."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, STEP_DEG, VOXEL_M, Graph

from csas_shadow_ros.bags import BagReader, read_run, write_run
from csas_shadow_ros.core.imaging.likelihood import outside_likelihood
from csas_shadow_ros.core.pipeline import ProcessedView, Result
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.bag_recorder import BagRecorderNode
from csas_shadow_ros.nodes.composites import CompositesNode
from csas_shadow_ros.nodes.runtime.base import CsasNode
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import SimulatedRun, simulate
from msg_adapters import (
    RclpyMessages,
    TargetBox,
    mesh_from_msg,
    target_from_msg,
    target_to_msg,
    view_from_msgs,
    view_to_msgs,
    voxel_grid_from_msgs,
)

Reference = tuple[Result, list[ProcessedView]]
SOFT = {"method": "soft", "voxel_size_m": VOXEL_M}


def assert_same_grid(carver: VoxelCarverNode, reference: Reference) -> None:
    """Compare with the grid of the in-process pipeline: bit for bit, the sums are of integers."""
    result = reference[0]
    grids = [g for g in (result.grid, result.other_grid) if g and g.method == carver.parameters.method]
    assert grids, f"the reference has no {carver.parameters.method} grid"
    assert carver.reconstruction is not None
    grid = carver.reconstruction.bodies[0].carver.grid()
    np.testing.assert_array_equal(grid.likelihood, grids[0].likelihood)
    np.testing.assert_array_equal(grid.views, grids[0].views)
    np.testing.assert_array_equal(grid.occupied, grids[0].occupied)


def whole_graph(
    graph: Graph, bag: Path, target: dict[str, Any] | None = None, **carving: Any
) -> dict[str, Any]:
    """Start every node that turns a bag of an image into a grid."""
    finding = {"check_sign": False, **target} if target else {}
    carver = graph.add(VoxelCarverNode, **({"voxel_size_m": VOXEL_M} | carving))
    nodes = {
        "carver": carver,
        "likelihood": graph.add(ShadowLikelihoodNode),
        "enhancement": graph.add(ShadowEnhancementNode),
        "sub_aperture": graph.add(SubApertureNode, step_deg=STEP_DEG, min_sinks=1, **finding),
        "player": graph.add(BagPlayerNode, bag=str(bag)),
    }
    return nodes


def complete(node: Any) -> Callable[[], bool]:
    """Say whether a growing result is complete."""
    return lambda: bool(node.growing.complete)


def given_target(reference: Reference) -> dict[str, Any]:
    """Parameters of the reference's target."""
    target = reference[0].target
    assert target is not None
    return {"target": "given", "position_m": list(target.position_m), "size_m": list(target.size_m)}


def test_the_graph_leaves_the_grid_of_the_pipeline(graph: Graph, run_bag: Path, reference: Reference) -> None:
    got: dict[str, Any] = {}
    nodes = whole_graph(graph, run_bag)
    composites = graph.add(CompositesNode)
    graph.spin_until(complete(nodes["carver"]))
    graph.spin_until(complete(composites))
    assert_same_grid(nodes["carver"], reference)
    flow = nodes["sub_aperture"].source.flow
    assert flow.finished
    assert flow.done == flow.total == 36
    assert not flow.lost
    # What a late subscriber gets is the final result.
    messages = RclpyMessages()
    viewer = graph.plain_node("viewer")
    for topic, kind in (
        ("voxel_grid/image", "sensor_msgs/msg/Image"),
        ("voxel_grid/camera_info", "sensor_msgs/msg/CameraInfo"),
        ("mesh", "visualization_msgs/msg/Marker"),
        ("target", "visualization_msgs/msg/Marker"),
        ("color_by_aspect/image", "sensor_msgs/msg/Image"),
    ):
        viewer.create_subscription(
            messages.cls(kind), topic, lambda m, t=topic: got.__setitem__(t, m), qos.LATCHED
        )
    graph.spin_until(lambda: len(got) == 5)
    stamp, volume, likelihood = voxel_grid_from_msgs(got["voxel_grid/image"], got["voxel_grid/camera_info"])
    result = reference[0]
    assert result.grid is not None
    assert result.mesh is not None
    assert result.target is not None
    np.testing.assert_array_equal(likelihood, result.grid.likelihood)
    assert volume.shape == result.grid.volume.shape
    assert stamp == max(v.shadow.info.stamp_ns for v in reference[1])
    mesh = mesh_from_msg(got["mesh"])
    assert mesh is not None
    assert len(mesh.faces) == len(result.mesh.faces)
    box = target_from_msg(got["target"])
    assert box is not None
    assert box.centre_m[:2] == result.target.position_m
    assert box.size_m == result.target.size_m


KINDS: dict[str, type[CsasNode]] = {
    "carver": VoxelCarverNode,
    "likelihood": ShadowLikelihoodNode,
    "enhancement": ShadowEnhancementNode,
    "sub_aperture": SubApertureNode,
    "player": BagPlayerNode,
}


@pytest.mark.parametrize("victim", list(KINDS))
def test_a_node_killed_in_mid_run_and_started_again_leaves_the_same_grid(
    graph: Graph, run_bag: Path, reference: Reference, victim: str
) -> None:
    target = given_target(reference)
    nodes = whole_graph(graph, run_bag, target)
    graph.spin_until(lambda: nodes["carver"].state_counts()["views"] >= 12)
    assert not nodes["carver"].growing.complete
    overrides: dict[str, Any] = {
        "carver": {"voxel_size_m": VOXEL_M},
        "sub_aperture": {"step_deg": STEP_DEG, "check_sign": False, **target},
        "player": {"bag": str(run_bag)},
    }.get(victim, {})
    graph.kill(nodes[victim])
    nodes[victim] = graph.add(KINDS[victim], **overrides)
    graph.spin_until(complete(nodes["carver"]))
    graph.spin_until(lambda: nodes["sub_aperture"].source.flow.finished)
    assert_same_grid(nodes["carver"], reference)


def test_a_player_of_views_killed_in_mid_run_sends_what_the_grid_still_lacks(
    graph: Graph, view_bag: Callable[[str], Path], reference: Reference
) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT, **given_target(reference))
    bag = str(view_bag("likelihood"))
    player = graph.add(BagPlayerNode, bag=bag, rate=0.0, min_sinks=1)
    graph.spin_until(lambda: carver.state_counts()["views"] >= 12)
    graph.kill(player)
    again = graph.add(BagPlayerNode, bag=bag, rate=0.0)
    graph.spin_until(complete(carver))
    assert_same_grid(carver, reference)
    assert again.counts["sent"] < 36, "reports are kept: what is in the grid is not sent again"


@pytest.mark.parametrize("stage", ["sub_aperture", "shadow", "likelihood"])
def test_a_bag_may_begin_at_any_stage(
    graph: Graph, view_bag: Callable[[str], Path], reference: Reference, stage: str
) -> None:
    target = given_target(reference)
    carver = graph.add(VoxelCarverNode, **SOFT, **target)
    if stage != "likelihood":
        graph.add(ShadowLikelihoodNode, **target)
    if stage == "sub_aperture":
        graph.add(ShadowEnhancementNode, target="given", position_m=target["position_m"])
    graph.add(BagPlayerNode, bag=str(view_bag(stage)), rate=0.0, min_sinks=1)
    graph.spin_until(complete(carver))
    assert_same_grid(carver, reference)


def test_sectors_are_summed_to_the_image(
    graph: Graph, simulated: SimulatedRun, reference: Reference, tmp_path: Path
) -> None:
    image, track = simulated.image, simulated.track
    stamps = [int(stamp) for stamp in track.stamps_ns[[5, 6]]]
    half = image.pixels / 2  # exact in floats, so that the sum is the image again
    sectors = [Sector(half, image.grid, image.acoustics, s, 0.1 * i, 0.1) for i, s in enumerate(stamps)]
    bag = write_run(tmp_path / "sectors", None, track, sectors=sectors)
    nodes = whole_graph(graph, bag, method="soft")
    graph.spin_until(complete(nodes["carver"]))
    assert_same_grid(nodes["carver"], reference)


def publish_views(
    graph: Graph, name: str, stream: str, views: list[Any], profile: Any = qos.VIEWS
) -> tuple[Any, Callable[[], None]]:
    """Make an outside publisher that knows nothing of flow control."""
    messages = RclpyMessages()
    node = graph.plain_node(name)
    image = node.create_publisher(messages.cls("sensor_msgs/msg/Image"), f"{stream}/image", profile)
    info = node.create_publisher(messages.cls("sensor_msgs/msg/CameraInfo"), f"{stream}/camera_info", profile)
    graph.spin_until(lambda: image.get_subscription_count() > 0 and info.get_subscription_count() > 0)
    queue = list(views)

    def send_one() -> None:
        if queue:
            a, b = view_to_msgs(messages, queue.pop(0), stream)
            image.publish(a)
            info.publish(b)

    return node, send_one


@pytest.mark.parametrize("stream", ["shadow", "likelihood"])
def test_an_outside_processor_may_publish_at_any_stage(
    graph: Graph, reference: Reference, stream: str
) -> None:
    target = given_target(reference)
    carver = graph.add(VoxelCarverNode, **SOFT, **target)
    if stream == "shadow":
        graph.add(ShadowLikelihoodNode, **target)
    views = [getattr(v, stream) for v in reference[1]]
    _, send_one = publish_views(graph, "outside", stream, views)
    for count in range(1, len(views) + 1):
        send_one()
        graph.spin_until(lambda n=count: carver.state_counts()["views"] == n)
    assert_same_grid(carver, reference)
    graph.spin_until(lambda: not carver.growing._dirty, what="shown though no source tells the end")


def test_the_same_stamps_again_change_nothing(graph: Graph, reference: Reference) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT, **given_target(reference))
    views = [v.likelihood for v in reference[1]]
    _, send_one = publish_views(graph, "outside", "likelihood", views + views)
    for count in range(1, 2 * len(views) + 1):
        send_one()
        graph.spin_until(lambda n=count: carver.counts["in"] == n)
    assert_same_grid(carver, reference)
    assert carver.counts["duplicates"] == len(views)


def test_an_outside_classifier_without_reports_loses_nothing(
    graph: Graph, run_bag: Path, reference: Reference
) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT)
    graph.add(ShadowEnhancementNode)
    messages = RclpyMessages()
    node = graph.plain_node("classifier")
    image = node.create_publisher(messages.cls("sensor_msgs/msg/Image"), "likelihood/image", 4)
    info = node.create_publisher(messages.cls("sensor_msgs/msg/CameraInfo"), "likelihood/camera_info", 4)
    waiting: dict[int, Any] = {}

    def take(msg: Any) -> None:
        stamp = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
        other = waiting.pop(stamp, None)
        if other is None:
            waiting[stamp] = msg
            return
        pair = (msg, other) if hasattr(msg, "encoding") else (other, msg)
        view = outside_likelihood(view_from_msgs(*pair, "shadow"), PARAMETERS.likelihood)
        a, b = view_to_msgs(messages, view, "likelihood")
        image.publish(a)
        info.publish(b)

    node.create_subscription(messages.cls("sensor_msgs/msg/Image"), "shadow/image", take, 4)
    node.create_subscription(messages.cls("sensor_msgs/msg/CameraInfo"), "shadow/camera_info", take, 4)
    source = graph.add(SubApertureNode, step_deg=STEP_DEG, min_sinks=1)
    graph.add(BagPlayerNode, bag=str(run_bag))
    graph.spin_until(complete(carver))
    assert_same_grid(carver, reference)
    assert not source.source.flow.lost


def test_malformed_messages_are_dropped_counted_and_named_and_the_run_goes_on(
    graph: Graph, reference: Reference
) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT, **given_target(reference))
    views = [v.likelihood for v in reference[1]]
    node, send_one = publish_views(graph, "outside", "likelihood", views)
    messages = RclpyMessages()
    image_type = messages.cls("sensor_msgs/msg/Image")
    bad_image = node.create_publisher(image_type, "likelihood/image", qos.VIEWS)
    bad_info = node.create_publisher(
        messages.cls("sensor_msgs/msg/CameraInfo"), "likelihood/camera_info", qos.VIEWS
    )
    graph.spin_until(lambda: bad_image.get_subscription_count() * bad_info.get_subscription_count() > 0)

    def send_bad(change: Callable[[Any, Any], None]) -> None:
        before = carver.counts["rejected"]
        a, b = view_to_msgs(messages, views[0], "likelihood")
        change(a, b)
        bad_image.publish(a)
        bad_info.publish(b)
        graph.spin_until(lambda: carver.counts["rejected"] > before)

    def set_field(which: int, name: str, value: Any) -> Callable[[Any, Any], None]:
        return lambda a, b: setattr((a, b)[which], name, value)

    send_one()
    graph.spin_until(lambda: carver.state_counts()["views"] == 1)
    send_bad(set_field(0, "encoding", "32FC9"))
    send_bad(set_field(0, "step", 1))
    send_bad(set_field(0, "height", 3))
    send_bad(set_field(0, "data", b"\x00" * 7))
    send_bad(set_field(1, "distortion_model", "plumb_bob"))
    send_bad(set_field(1, "p", [float("nan")] * 12))
    for count in range(2, len(views) + 1):
        send_one()
        graph.spin_until(lambda n=count: carver.state_counts()["views"] == n)
    assert carver.counts["rejected"] == 6
    assert sorted(carver.reasons.values()) == [1] * 6, f"one kind each: {carver.reasons}"
    for field in ("encoding", "step", "height", "data", "distortion_model", "camera_info.p"):
        assert any(field in kind for kind in carver.reasons), field
    assert_same_grid(carver, reference)


def test_a_message_without_its_partner_is_named_and_dropped(graph: Graph, reference: Reference) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT, **given_target(reference))
    views = [v.likelihood for v in reference[1]]
    node, send_one = publish_views(graph, "outside", "likelihood", views)
    messages = RclpyMessages()
    lonely = node.create_publisher(messages.cls("sensor_msgs/msg/Image"), "likelihood/image", qos.VIEWS)
    graph.spin_until(lambda: lonely.get_subscription_count() > 0)
    a, _ = view_to_msgs(messages, views[0], "likelihood")
    a.header.stamp.sec += 77
    lonely.publish(a)
    for count in range(1, len(views) + 1):
        send_one()
        graph.spin_until(lambda n=count: carver.state_counts()["views"] == n)
    carver.inlet._last_s -= 100.0  # as if nothing had come for long
    carver.inlet.give_up_lonely()
    assert any("has no camera_info of the same stamp" in kind for kind in carver.reasons)
    assert_same_grid(carver, reference)


def test_without_a_target_views_are_held_and_not_guessed_at(
    graph: Graph, view_bag: Callable[[str], Path], reference: Reference
) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT)
    player = graph.add(BagPlayerNode, bag=str(view_bag("likelihood")), rate=0.0, resend_s=0.5)
    graph.spin_until(lambda: len(carver.inlet.held) >= 4)
    assert "no target position" in carver.waiting()
    assert carver.state_counts()["views"] == 0
    # Once it is known, all views come through.
    target = reference[0].target
    assert target is not None
    x, y = target.position_m
    outside = graph.plain_node("finder")
    messages = RclpyMessages()
    publisher = outside.create_publisher(messages.cls("visualization_msgs/msg/Marker"), "target", qos.LATCHED)
    publisher.publish(target_to_msg(messages, TargetBox((x, y, 1.0), target.size_m), 1))
    graph.spin_until(complete(carver))
    assert_same_grid(carver, reference)
    assert player.source.flow.finished


def test_an_empty_seabed_is_reported_as_no_object_and_the_run_ends(graph: Graph, tmp_path: Path) -> None:
    run = simulate("tiny", "empty", seed=2)
    bag = write_run(tmp_path / "empty", run.image, run.track)
    nodes = whole_graph(graph, bag)
    graph.spin_until(complete(nodes["carver"]))
    assert nodes["carver"].state_counts()["views"] == 0
    assert nodes["enhancement"].counts["rejected"] == 36
    assert any(kind.startswith("no target") for kind in nodes["enhancement"].reasons)


def test_an_image_with_the_wrong_sign_is_refused_by_name(
    graph: Graph, simulated: SimulatedRun, tmp_path: Path
) -> None:
    from dataclasses import replace

    image = replace(simulated.image, acoustics=replace(simulated.image.acoustics, spectrum_sign=-1))
    bag = write_run(tmp_path / "wrong", image, simulated.track)
    node = graph.add(SubApertureNode, step_deg=STEP_DEG)
    graph.add(BagPlayerNode, bag=str(bag))
    graph.spin_until(lambda: bool(node.error))
    assert node.error.startswith("SpectrumSignError")
    assert node.source.flow.total == 0


def test_a_recording_holds_every_view_of_every_stage_and_plays_to_the_same_grid(
    graph: Graph, run_bag: Path, reference: Reference, tmp_path: Path
) -> None:
    out = tmp_path / "recording"
    recorder = graph.add(BagRecorderNode, out=str(out))
    nodes = whole_graph(graph, run_bag)
    graph.spin_until(complete(nodes["carver"]))
    graph.spin_until(lambda: nodes["sub_aperture"].source.flow.finished)
    graph.nodes.remove(recorder)
    graph.executor.remove_node(recorder)
    recorder.stop()
    recorder.destroy_node()
    run = read_run(out)
    assert run.problems == []
    assert run.track is not None
    for stream in ("sub_aperture", "shadow", "likelihood", "shadow_mask"):
        assert run.counts[stream] == 36, stream
    by_stamp = {v.likelihood.info.stamp_ns: v.likelihood for v in reference[1]}
    for view in run.views("likelihood"):
        np.testing.assert_array_equal(view.pixels, by_stamp[view.info.stamp_ns].pixels)
    assert (out / "metadata.yaml").exists()


def test_a_killed_recorder_is_followed_by_one_that_keeps_what_was_recorded(
    graph: Graph, view_bag: Callable[[str], Path], tmp_path: Path
) -> None:
    out = tmp_path / "recording"
    bag = str(view_bag("likelihood"))
    recorder = graph.add(BagRecorderNode, out=str(out))
    player = graph.add(BagPlayerNode, bag=bag, rate=0.0, min_sinks=1)
    graph.spin_until(lambda: recorder.counts["integrated"] >= 12)
    writer = recorder._bags[-1].writer
    writer.flush()
    lock, recorder._lock = recorder._lock, None  # what the operating system does with a dead process' lock
    lock.close()
    writer._stream.close()
    graph.kill(recorder)
    sent = player.counts["sent"]
    graph.add(BagRecorderNode, out=str(out))
    graph.spin_until(lambda: player.source.flow.finished)
    assert player.counts["sent"] - sent < 36, "what was recorded is not sent again"
    graph.nodes[-1].stop()
    run = read_run(out)
    assert run.counts["likelihood"] == 36
    assert run.problems == []
    assert not out.with_name("recording.cut").exists()


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_recorder_that_is_killed_while_it_takes_a_bag_over_loses_nothing_of_it(
    graph: Graph, run_bag: Path, tmp_path: Path, share: float
) -> None:
    out = tmp_path / "recording"
    cut = out.with_name("recording.cut")
    out.with_name("recording.taken").mkdir()  # of one that was killed even earlier
    shutil.copytree(run_bag, cut)  # what the first one left
    (cut / "metadata.yaml").unlink()
    (whole,) = cut.glob("*.mcap")
    if share:
        out.mkdir()  # what its successor had written of it when it was killed too
        (out / "recording_0.mcap").write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    recorder = graph.add(BagRecorderNode, out=str(out))
    graph.executor.remove_node(recorder)
    graph.nodes.remove(recorder)
    recorder.stop()
    recorder.destroy_node()
    found, left = (
        sorted((m.topic, bytes(m.cdr)) for m in BagReader(bag).messages()) for bag in (out, run_bag)
    )
    assert found == left
    assert sorted(path.name for path in tmp_path.glob("recording*")) == ["recording"]


def test_a_recorder_that_begins_anew_goes_on_with_the_bag_of_its_last_run(
    graph: Graph, run_bag: Path, tmp_path: Path
) -> None:
    first, last = tmp_path / "recording", tmp_path / "recording_2"
    for path in (first, last):
        shutil.copytree(run_bag, path)
    (kept,), (left,) = first.glob("*.mcap"), last.glob("*.mcap")
    before = kept.stat().st_ino, left.stat().st_ino
    recorder = graph.add(BagRecorderNode, out=str(first), resume=True)
    graph.executor.remove_node(recorder)
    graph.nodes.remove(recorder)
    recorder.stop()
    recorder.destroy_node()
    assert sorted(path.name for path in tmp_path.glob("recording*")) == ["recording", "recording_2"]
    (left,) = last.glob("*.mcap")
    assert kept.stat().st_ino == before[0], "what is whole is not written again"
    assert left.stat().st_ino != before[1], "the last run's bag is"
    found, whole = (
        sorted((m.topic, bytes(m.cdr)) for m in BagReader(bag).messages()) for bag in (last, run_bag)
    )
    assert found == whole


def test_an_unfinished_recording_that_cannot_be_read_is_kept_under_another_name(
    graph: Graph, tmp_path: Path
) -> None:
    out = tmp_path / "recording"
    out.mkdir()
    (out / "recording_0.mcap").write_bytes(b"no bag at all")
    graph.add(BagRecorderNode, out=str(out))
    assert (tmp_path / "recording.unusable" / "recording_0.mcap").read_bytes() == b"no bag at all"


@pytest.mark.parametrize("sync", [True, False])
def test_a_recorder_writes_its_bag_out_to_the_disk_at_its_end_unless_told_otherwise(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sync: bool
) -> None:
    out = tmp_path / "recording"
    recorder = graph.add(BagRecorderNode, out=str(out), sync=sync)
    synced, fsync = set(), os.fsync

    def noted(number: int) -> None:
        synced.add(os.fstat(number).st_ino)
        fsync(number)

    monkeypatch.setattr(os, "fsync", noted)
    recorder.stop()
    there = [*out.iterdir(), out, tmp_path]
    assert {p.name for p in there} >= {"metadata.yaml", "recording_0.mcap"}
    assert {p.stat().st_ino in synced for p in there} == {sync}


def test_a_bag_is_recorded_by_one_recorder_at_a_time(graph: Graph, tmp_path: Path) -> None:
    graph.add(BagRecorderNode, out=str(tmp_path / "recording"))
    second = BagRecorderNode(context=graph.context, overrides={"out": str(tmp_path / "recording")})
    try:
        assert not second.start()
        assert "is being recorded by another process" in second.error
    finally:
        second.destroy_node()


def test_a_result_says_that_views_were_lost_on_their_way(
    graph: Graph, view_bag: Callable[[str], Path], reference: Reference
) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT, **given_target(reference))
    player = graph.add(BagPlayerNode, bag=str(view_bag("likelihood")), rate=0.0, min_sinks=1)
    graph.spin_until(lambda: carver.state_counts()["views"] >= 6)
    player.source.flow.lost[max(v.shadow.info.stamp_ns for v in reference[1])] = "the test has taken it"
    graph.spin_until(complete(carver))
    assert carver.state_counts()["views"] == 35
    assert carver.result.quality.verdict == "limited"
    assert "1 of 36 views were lost on their way" in carver.result.quality.reasons


def test_a_lifecycle_manager_can_hold_end_and_begin_a_run_again(
    graph: Graph, view_bag: Callable[[str], Path], reference: Reference
) -> None:
    carver = graph.add(VoxelCarverNode, **SOFT, **given_target(reference))
    player = graph.add(BagPlayerNode, bag=str(view_bag("likelihood")), rate=0.0, min_sinks=1)
    graph.spin_until(lambda: carver.state_counts()["views"] >= 6)
    carver.trigger_deactivate()
    held = carver.state_counts()["views"]
    player.source.wake()
    carver.trigger_activate()
    graph.spin_until(complete(carver))
    assert carver.state_counts()["views"] == 36 > held
    assert_same_grid(carver, reference)
    for step in ("deactivate", "cleanup", "configure", "activate"):
        getattr(carver, f"trigger_{step}")()
    assert carver.state_counts()["views"] == 0
    graph.spin_until(complete(carver), what="the run that begins again gets every view")
    assert_same_grid(carver, reference)
