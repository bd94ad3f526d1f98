"""One contact after another through one live graph: each run's result is its own, whatever happens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, STEP_DEG, VOXEL_M, Graph

from csas_shadow_ros.bags import BagReader, read_run
from csas_shadow_ros.core.geometry import Track
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.pipeline import Result, run
from csas_shadow_ros.nodes import qos
from csas_shadow_ros.nodes.bag_recorder import BagRecorderNode
from csas_shadow_ros.nodes.composites import CompositesNode
from csas_shadow_ros.nodes.playing import header_stamp
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import SimulatedRun, simulate
from csas_shadow_ros.simulation.sectors import sectors_of_run
from csas_shadow_ros.simulation.targets import box
from msg_adapters import (
    RclpyMessages,
    coherent_image_to_msgs,
    measurements_from_msg,
    sector_to_msgs,
    topic,
    track_to_msg,
    view_to_msgs,
    voxel_grid_from_msgs,
    voxel_grid_to_msgs,
)

#: Seconds between the circles of two contacts: more than one takes.
APART_NS = 1000 * 10**9
MESSAGES = RclpyMessages()


def later(simulated: SimulatedRun, by_ns: int) -> SimulatedRun:
    """Return a run that was sailed later."""
    track = Track(simulated.track.stamps_ns + by_ns, simulated.track.positions_m)
    image = replace(simulated.image, stamp_ns=simulated.image.stamp_ns + by_ns)
    return replace(simulated, image=image, track=track)


@pytest.fixture(scope="module")
def contacts() -> list[SimulatedRun]:
    """Three contacts, each in its own place, circled one after another."""
    scenes = (
        (box(0.8, 0.4, 0.4), (0.0, 0.0), 0.0),
        (box(0.5, 0.5, 0.25), (0.2, -0.1), 40.0),
        (box(0.6, 0.3, 0.35), (-0.15, 0.1), 70.0),
    )
    return [
        later(simulate("tiny", body, seed=n, position_m=place, heading_deg=heading), n * APART_NS)
        for n, (body, place, heading) in enumerate(scenes)
    ]


@pytest.fixture(scope="module")
def alone(contacts: list[SimulatedRun]) -> list[Result]:
    """What each circle leaves by itself."""
    return [run(one.image, one.track, PARAMETERS) for one in contacts]


@dataclass(eq=False)
class Listener:
    """Keeps the last result of each run that was published as final."""

    graph: Graph

    def __post_init__(self) -> None:
        self.latest: dict[str, Any] = {}
        self.final: dict[int | None, tuple[Any, np.ndarray]] = {}
        node = self.graph.plain_node("listener")
        for name in ("voxel_grid/image", "voxel_grid/camera_info", "measurements"):
            node.create_subscription(
                MESSAGES.cls(topic(name).type_name), name, lambda m, n=name: self.take(n, m), qos.LATCHED
            )

    def take(self, name: str, message: Any) -> None:
        self.latest[name] = message
        if "measurements" not in self.latest or "voxel_grid/image" not in self.latest:
            return
        told = measurements_from_msg(self.latest["measurements"])
        image, info = self.latest["voxel_grid/image"], self.latest.get("voxel_grid/camera_info")
        same = info is not None and image.header.stamp == info.header.stamp
        if told.final and same and image.header.stamp == self.latest["measurements"].header.stamp:
            self.final[told.run_ns] = told, voxel_grid_from_msgs(image, info)[2]


class Vehicle:
    """Publishes what an outside processor would."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        node = graph.plain_node("vehicle")
        self.publishers = {
            name: node.create_publisher(MESSAGES.cls(topic(name).type_name), name, profile)
            for name, profile in (
                ("image", qos.LATCHED),
                ("camera_info", qos.LATCHED),
                ("track", qos.LATCHED),
                ("sector/image", qos.VIEWS),
                ("sector/camera_info", qos.VIEWS),
            )
        }
        self.graph.spin_until(
            lambda: all(p.get_subscription_count() for p in self.publishers.values()), what="matching"
        )

    def send(self, name: str, message: Any) -> None:
        self.publishers[name].publish(message)
        self.graph.executor.spin_once(timeout_sec=0.01)

    def send_track(self, one: SimulatedRun) -> None:
        self.send("track", track_to_msg(MESSAGES, one.track))

    def send_image(self, one: SimulatedRun) -> None:
        image, info = coherent_image_to_msgs(MESSAGES, one.image)
        self.send("camera_info", info)
        self.send("image", image)

    def send_sectors(self, one: SimulatedRun, taken: Any) -> None:
        for number, (sector, _) in enumerate(sectors_of_run(one.image, one.track, 30.0), start=1):
            image, info = sector_to_msgs(MESSAGES, sector)
            self.send("sector/camera_info", info)
            self.send("sector/image", image)
            # An outside publisher that nobody paces: it makes a sector when the sonar has passed its arc.
            self.graph.spin_until(lambda n=number: taken() >= n, what=f"sector {number}")


def start_graph(graph: Graph) -> dict[str, Any]:
    return {
        "sub_aperture": graph.add(SubApertureNode, step_deg=STEP_DEG, first_search_deg=360.0),
        "shadow_enhancement": graph.add(ShadowEnhancementNode),
        "shadow_likelihood": graph.add(ShadowLikelihoodNode),
        "voxel_carver": graph.add(VoxelCarverNode, voxel_size_m=VOXEL_M),
        "composites": graph.add(CompositesNode),
    }


def assert_own(listener: Listener, one: SimulatedRun, expected: Result) -> None:
    """Compare a run's final result with what its circle leaves by itself."""
    name = int(one.track.stamps_ns[0])
    listener.graph.spin_until(lambda: name in listener.final, 60.0, f"the result of run {name}")
    told, likelihood = listener.final[name]
    assert expected.grid is not None
    np.testing.assert_array_equal(likelihood, expected.grid.likelihood)
    assert told.verdict == expected.verdict
    assert told.quality == expected.quality
    assert [o.dimensions for o in told.objects] == [o.dimensions for o in expected.objects]
    assert told.views_used == expected.views_used
    assert told.grid is not None
    assert told.grid.seabed == expected.grid.seabed


@pytest.mark.parametrize("kind", ["image", "sectors"])
@pytest.mark.parametrize(
    "killed",
    [
        None,
        "voxel_carver",
        pytest.param("shadow_likelihood", marks=pytest.mark.long),
        pytest.param("composites", marks=pytest.mark.long),
    ],
)
def test_three_circles_over_three_contacts_leave_three_results_each_its_own(
    graph: Graph, contacts: list[SimulatedRun], alone: list[Result], kind: str, killed: str | None
) -> None:
    nodes, listener, vehicle = start_graph(graph), Listener(graph), Vehicle(graph)
    for number, (one, expected) in enumerate(zip(contacts, alone, strict=True)):
        vehicle.send_track(one)
        if kind == "image":
            vehicle.send_image(one)
        else:
            before = nodes["sub_aperture"].sector_inlet.node.counts["integrated"]
            vehicle.send_sectors(
                one, lambda before=before: nodes["sub_aperture"].counts["integrated"] - before
            )
        if number == 1 and killed:
            flow = nodes["sub_aperture"].sources[0].flow
            graph.spin_until(lambda f=flow: 3 <= f.done < f.total, what="views on their way")
            old = nodes[killed]
            graph.kill(old)
            options = {"voxel_size_m": VOXEL_M} if killed == "voxel_carver" else {}
            nodes[killed] = graph.add(type(old), **options)
        assert_own(listener, one, expected)
    assert len(listener.final) == 3
    for node in nodes.values():
        assert not node.counts["rejected"], (node.name, dict(node.reasons))
    assert min(nodes["composites"].composites.stamps) >= contacts[2].track.stamps_ns[0]


def test_each_run_is_recorded_into_a_bag_of_its_own_that_leaves_the_same_grid_again(
    graph: Graph, contacts: list[SimulatedRun], alone: list[Result], tmp_path: Path
) -> None:
    out = tmp_path / "mission"
    recorder = graph.add(BagRecorderNode, out=str(out))
    start_graph(graph)
    listener, vehicle = Listener(graph), Vehicle(graph)
    for one, expected in zip(contacts[:2], alone[:2], strict=True):
        vehicle.send_track(one)
        vehicle.send_image(one)
        assert_own(listener, one, expected)
    recorded = recorder.counts["written"]
    graph.spin_until(lambda: recorder.counts["in"] >= 2 * 4 * 36, what=f"all views recorded, {recorded} now")
    recorder.stop()
    for path, one, expected in zip((out, tmp_path / "mission_2"), contacts[:2], alone[:2], strict=True):
        bag = read_run(path)
        assert bag.problems == []
        assert bag.run_names == (int(one.track.stamps_ns[0]),)
        assert bag.image is not None
        assert bag.image.stamp_ns == one.image.stamp_ns
        assert bag.counts["shadow_mask"] == 36
        again = run(bag.image, bag.require_track(), PARAMETERS)
        assert again.grid is not None
        assert expected.grid is not None
        np.testing.assert_array_equal(again.grid.likelihood, expected.grid.likelihood)
        assert again.dimensions == expected.dimensions
    assert not (tmp_path / "mission_3").exists()


def test_a_view_that_comes_before_its_track_is_recorded_into_its_own_run_s_bag(
    graph: Graph, contacts: list[SimulatedRun], tmp_path: Path
) -> None:
    """A recorder that has just begun again hears views of the next run before that run's track."""
    out = tmp_path / "mission"
    recorder = graph.add(BagRecorderNode, out=str(out))
    node = graph.plain_node("vehicle")

    def publisher(name: str, profile: Any) -> Any:
        return node.create_publisher(MESSAGES.cls(topic(name).type_name), name, profile)

    track = publisher("track", qos.LATCHED)
    views = [publisher(f"sub_aperture/{part}", qos.VIEWS) for part in ("image", "camera_info")]
    graph.spin_until(lambda: all(p.get_subscription_count() for p in (track, *views)))
    made = [
        SubApertures(one.image, one.track, PARAMETERS.sub_aperture).view_of_aspect(0.0)
        for one in contacts[:2]
    ]

    def send(view: Any) -> None:
        for one, message in zip(views, view_to_msgs(MESSAGES, view, "sub_aperture"), strict=True):
            one.publish(message)

    track.publish(track_to_msg(MESSAGES, contacts[0].track))
    graph.spin_until(lambda: recorder.counts["written"] >= 1)
    send(made[0])
    graph.spin_until(lambda: recorder.counts["integrated"] == 1)
    send(made[1])
    graph.spin_until(lambda: recorder.state_counts()["waiting_for_track"] == 2, what="both its messages wait")
    track.publish(track_to_msg(MESSAGES, contacts[1].track))
    graph.spin_until(lambda: recorder.counts["integrated"] == 2)
    recorder.stop()
    for path, view in zip((out, tmp_path / "mission_2"), made, strict=True):
        bag = read_run(path)
        assert bag.counts["sub_aperture"] == 1
        assert [one.info.stamp_ns for one in bag.views("sub_aperture")] == [view.info.stamp_ns]


@pytest.mark.parametrize("track_first", [True, False])
def test_a_recorder_that_begins_late_leaves_the_result_of_the_run_before_out_of_its_bag(
    graph: Graph,
    contacts: list[SimulatedRun],
    alone: list[Result],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    track_first: bool,
) -> None:
    """The last result stays published: whoever begins in the next run hears it, without its track."""
    monkeypatch.setattr("csas_shadow_ros.nodes.bag_recorder.HOLD_S", 0.5)
    node = graph.plain_node("vehicle")
    names = ("voxel_grid/image", "voxel_grid/camera_info", "track")
    publishers = {
        name: node.create_publisher(MESSAGES.cls(topic(name).type_name), name, qos.LATCHED) for name in names
    }

    def send_result(number: int) -> None:
        stamp = contacts[number].image.stamp_ns
        grid = alone[number].grid
        assert grid is not None
        image, info = voxel_grid_to_msgs(MESSAGES, grid.volume, grid.likelihood, stamp)
        publishers["voxel_grid/image"].publish(image)
        publishers["voxel_grid/camera_info"].publish(info)

    def send_track(number: int) -> None:
        publishers["track"].publish(track_to_msg(MESSAGES, contacts[number].track))

    send_result(0)
    if track_first:
        send_track(1)
    recorder = graph.add(BagRecorderNode, out=str(tmp_path / "late"), topics=",".join(names))
    if not track_first:
        graph.spin_until(lambda: recorder.state_counts()["waiting_for_track"] == 2, what="both wait")
        send_track(1)
    graph.spin_until(lambda: recorder.counts["written"] >= 1, what="the track")
    graph.spin_until(
        lambda: any("of a run before" in text for text in recorder.examples.values()), what="refusal"
    )
    send_result(1)
    graph.spin_until(lambda: recorder.counts["written"] == 3, what="its own result")
    recorder.stop()
    with BagReader(tmp_path / "late") as bag:
        stamps = {header_stamp(m.cdr, m.topic) for m in bag.messages() if "voxel_grid" in m.topic}
    assert stamps == {contacts[1].image.stamp_ns}


@pytest.mark.parametrize("image_first", [True, False])
def test_the_next_contact_may_come_before_the_last_one_is_through(
    graph: Graph, contacts: list[SimulatedRun], alone: list[Result], image_first: bool
) -> None:
    source = start_graph(graph)["sub_aperture"]
    listener, vehicle = Listener(graph), Vehicle(graph)
    order = (vehicle.send_image, vehicle.send_track)
    for one in contacts[:2]:
        for send in order if image_first else order[::-1]:
            send(one)
        # Of a latched topic a reader that has had no time gets the last message alone.
        stamp = one.image.stamp_ns
        graph.spin_until(lambda s=stamp: any(run.image_stamp == s for run in source.runs), what="image")
    for one, expected in zip(contacts[:2], alone[:2], strict=True):
        assert_own(listener, one, expected)


def test_what_no_track_covers_is_held_a_while_and_refused_by_name(
    graph: Graph, contacts: list[SimulatedRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    from csas_shadow_ros.nodes.runtime import runs

    monkeypatch.setattr(runs, "HOLD_S", 1.0)
    monkeypatch.setattr("csas_shadow_ros.nodes.sub_aperture.HOLD_S", 1.0)
    nodes, vehicle = start_graph(graph), Vehicle(graph)
    vehicle.send_track(contacts[0])
    vehicle.send_image(contacts[1])
    source = nodes["sub_aperture"]
    graph.spin_until(lambda: bool(source.counts["rejected"]), 10.0, "refusal")
    reason = next(iter(source.examples.values()))
    assert f"image stamped {contacts[1].image.stamp_ns} ns: no track covers its stamp" in reason
    assert str(contacts[0].track.stamps_ns[0]) in reason
    assert source.run is None


def test_a_second_image_of_a_run_is_refused_by_name(graph: Graph, contacts: list[SimulatedRun]) -> None:
    source, vehicle = start_graph(graph)["sub_aperture"], Vehicle(graph)
    vehicle.send_track(contacts[0])
    vehicle.send_image(contacts[0])
    graph.spin_until(lambda: source.run is not None and source.run.image_stamp is not None)
    again = replace(contacts[0].image, stamp_ns=contacts[0].image.stamp_ns - 10**9)
    vehicle.send_image(replace(contacts[0], image=again))
    graph.spin_until(lambda: bool(source.counts["rejected"]))
    assert "the same run by its track" in next(iter(source.examples.values()))
