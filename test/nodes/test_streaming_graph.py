"""Sectors through the graph of nodes: views while they come, and the grid of the whole run at the end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, STEP_DEG, VOXEL_M, Graph

from csas_shadow_ros.bags import read_run, write_run
from csas_shadow_ros.core.pipeline import Result, run
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.core.sectors.streaming import Stream
from csas_shadow_ros.nodes import qos, sub_aperture
from csas_shadow_ros.nodes.bag_player import BagPlayerNode
from csas_shadow_ros.nodes.shadow_enhancement import ShadowEnhancementNode
from csas_shadow_ros.nodes.shadow_likelihood import ShadowLikelihoodNode
from csas_shadow_ros.nodes.sub_aperture import SubApertureNode
from csas_shadow_ros.nodes.voxel_carver import VoxelCarverNode
from csas_shadow_ros.simulation import SimulatedRun
from csas_shadow_ros.simulation.sectors import sectors_of_run
from msg_adapters import RclpyMessages, progress_from_msg, sector_to_msgs, track_to_msg

SECTOR_DEG = 15.0


@pytest.fixture(scope="session")
def sector_bag(simulated: SimulatedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run as 24 sectors, each as soon as the sonar has passed its arc: five minutes."""
    made = list(sectors_of_run(simulated.image, simulated.track, SECTOR_DEG))
    times = {sector.stamp_ns: when for sector, when in made}
    path = tmp_path_factory.mktemp("bags") / "sectors"
    return write_run(path, None, simulated.track, sectors=[s for s, _ in made], sector_times_ns=times)


@pytest.fixture(scope="session")
def reference_of_sectors(sector_bag: Path) -> Result:
    """The same bag in one process."""
    bag = read_run(sector_bag)
    return run(bag.coherent_image(), bag.require_track(), PARAMETERS, spectrum=bag.sector_sum().spectrum)


def given(result: Result) -> dict[str, Any]:
    target = result.target
    assert target is not None
    return {"target": "given", "position_m": list(target.position_m), "size_m": list(target.size_m)}


def streaming_graph(graph: Graph, bag: Path | None, rate: float, **sub_aperture: Any) -> dict[str, Any]:
    nodes = {
        "carver": graph.add(VoxelCarverNode, voxel_size_m=VOXEL_M, publish_hz=10.0),
        "likelihood": graph.add(ShadowLikelihoodNode),
        "enhancement": graph.add(ShadowEnhancementNode),
        "sub_aperture": graph.add(SubApertureNode, step_deg=STEP_DEG, min_sinks=1, **sub_aperture),
    }
    if bag is not None:
        nodes["player"] = graph.add(BagPlayerNode, bag=str(bag), rate=rate, min_sinks=1)
    return nodes


def assert_same_grid(carver: VoxelCarverNode, result: Result) -> None:
    assert carver.reconstruction is not None
    assert result.grid is not None
    grid = carver.reconstruction.bodies[0].carver.grid()
    np.testing.assert_array_equal(grid.likelihood, result.grid.likelihood)
    np.testing.assert_array_equal(grid.views, result.grid.views)
    np.testing.assert_array_equal(grid.occupied, result.grid.occupied)


def complete(nodes: dict[str, Any]) -> Callable[[], bool]:
    return lambda: nodes["carver"].growing.complete and nodes["sub_aperture"].source.flow.finished


def test_views_come_while_sectors_do_and_the_grid_is_that_of_the_whole_run(
    graph: Graph, sector_bag: Path, reference_of_sectors: Result
) -> None:
    nodes = streaming_graph(graph, sector_bag, 30.0, **given(reference_of_sectors))
    viewer, seen = graph.plain_node("viewer"), []
    messages = RclpyMessages()
    marker = messages.cls("visualization_msgs/msg/Marker")

    def see(mesh: Any) -> None:
        if mesh.points and not nodes["carver"].growing.complete:
            seen.append((nodes["carver"].state_counts()["arc_deg"], set(nodes["carver"].state_values())))

    viewer.create_subscription(marker, "mesh", see, qos.LATCHED)
    graph.spin_until(lambda: nodes["carver"].state_counts()["views"] >= 6)
    assert nodes["sub_aperture"].state_counts()["sectors"] < 24, "the sonar still goes round"
    graph.spin_until(complete(nodes), 60.0)
    # How many shapes come depends on what one takes; of an unfinished circle one comes at least.
    arcs = [arc for arc, _ in seen]
    assert any(0 < arc < 360 for arc in arcs), arcs
    assert {"run", "verdict", "length_m", "width_m", "height_m"} <= set.union(*(told for _, told in seen))
    assert_same_grid(nodes["carver"], reference_of_sectors)
    assert nodes["sub_aperture"].state_counts()["arc_deg"] == 360
    assert nodes["sub_aperture"].state_counts()["revision"] == 0
    assert nodes["carver"].state_counts()["arc_deg"] == 360


def test_sectors_on_lattices_of_their_own_give_the_grid_of_the_whole_run(
    graph: Graph, simulated: SimulatedRun, tmp_path: Path
) -> None:
    made = list(sectors_of_run(simulated.image, simulated.track, SECTOR_DEG, "own"))
    bag = write_run(
        tmp_path / "own",
        None,
        simulated.track,
        sectors=[sector for sector, _ in made],
        sector_times_ns={sector.stamp_ns: when for sector, when in made},
    )
    assert len({sector.grid.shape for sector, _ in made}) > 3
    there = read_run(bag)
    spectrum = there.sector_sum().spectrum
    reference = run(there.coherent_image(), there.require_track(), PARAMETERS, spectrum=spectrum)
    nodes = streaming_graph(graph, bag, 200.0, **given(reference))
    graph.spin_until(complete(nodes), 60.0)
    assert nodes["sub_aperture"].state_counts()["sectors"] == 24
    assert_same_grid(nodes["carver"], reference)
    whole = run(simulated.image, simulated.track, PARAMETERS)
    assert reference.dimensions is not None
    assert whole.dimensions is not None
    for name in ("length_m", "width_m", "height_m"):
        assert abs(getattr(reference.dimensions, name) - getattr(whole.dimensions, name)) < VOXEL_M / 2


def test_the_last_sectors_views_are_through_before_the_whole_circle_is_searched(
    graph: Graph, sector_bag: Path, reference_of_sectors: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    through: list[int] = []
    decide = Stream._decide

    def counted(stream: Stream, track: Any) -> None:
        through.append(nodes["carver"].state_counts()["views"])
        decide(stream, track)

    monkeypatch.setattr(Stream, "_decide", counted)
    monkeypatch.setattr(sub_aperture, "_DECIDE_S", 60.0)  # on a busy machine too
    nodes = streaming_graph(graph, sector_bag, 60.0, **given(reference_of_sectors))
    graph.spin_until(complete(nodes), 60.0)
    assert through == [36]
    assert_same_grid(nodes["carver"], reference_of_sectors)


def test_the_target_of_an_open_circle_moves_when_it_is_closed_and_all_is_carved_again(
    graph: Graph, sector_bag: Path, reference_of_sectors: Result
) -> None:
    nodes = streaming_graph(graph, sector_bag, 30.0)
    graph.spin_until(lambda: nodes["carver"].state_counts()["views"] >= 1)  # sectors do not wait for views
    assert nodes["sub_aperture"].state_counts()["arc_deg"] < 360
    first = nodes["carver"].target.target
    graph.spin_until(complete(nodes), 60.0)
    assert nodes["sub_aperture"].state_counts()["revision"] == 1
    target = nodes["carver"].target.target
    assert reference_of_sectors.target is not None
    assert target.position_m == reference_of_sectors.target.position_m
    assert target.position_m != first.position_m
    assert_same_grid(nodes["carver"], reference_of_sectors)
    assert not nodes["sub_aperture"].source.flow.lost


KINDS: dict[str, Any] = {
    "carver": (VoxelCarverNode, {"voxel_size_m": VOXEL_M}),
    "likelihood": (ShadowLikelihoodNode, {}),
    "enhancement": (ShadowEnhancementNode, {}),
    "sub_aperture": (SubApertureNode, {"step_deg": STEP_DEG, "min_sinks": 1}),
    "player": (BagPlayerNode, {"rate": 60.0, "min_sinks": 1}),
}


@pytest.mark.parametrize("victim", list(KINDS))
def test_a_node_killed_while_sectors_come_leaves_the_same_grid(
    graph: Graph, sector_bag: Path, reference_of_sectors: Result, victim: str
) -> None:
    nodes = streaming_graph(graph, sector_bag, 60.0)
    graph.spin_until(lambda: nodes["carver"].state_counts()["views"] >= 8)
    graph.kill(nodes[victim])
    kind, own = KINDS[victim]
    nodes[victim] = graph.add(kind, **(own | ({"bag": str(sector_bag)} if victim == "player" else {})))
    graph.spin_until(complete(nodes), 90.0)
    assert_same_grid(nodes["carver"], reference_of_sectors)


def publish_sectors(graph: Graph, run: SimulatedRun, sectors: list[Sector]) -> Callable[[], None]:
    """Make an outside processor that knows nothing of flow control; returns what sends the next sector."""
    messages = RclpyMessages()
    node = graph.plain_node("processor")
    image = node.create_publisher(messages.cls("sensor_msgs/msg/Image"), "sector/image", qos.VIEWS)
    info = node.create_publisher(messages.cls("sensor_msgs/msg/CameraInfo"), "sector/camera_info", qos.VIEWS)
    track = node.create_publisher(messages.cls("nav_msgs/msg/Path"), "track", qos.LATCHED)
    track.publish(track_to_msg(messages, run.track))
    graph.spin_until(lambda: image.get_subscription_count() > 0 and info.get_subscription_count() > 0)
    queue = list(sectors)

    def send() -> None:
        if queue:
            a, b = sector_to_msgs(messages, queue.pop(0))
            image.publish(a)
            info.publish(b)

    return send


def test_repeated_late_and_disordered_sectors_of_an_outside_processor_are_counted_and_the_grid_is_right(
    graph: Graph, simulated: SimulatedRun, reference_of_sectors: Result
) -> None:
    made = [sector for sector, _ in sectors_of_run(simulated.image, simulated.track, SECTOR_DEG)]
    order = [*made[:3], made[2], made[4], made[3], *made[5:12], *made[13:], made[12]]
    nodes = streaming_graph(graph, None, 0.0, **given(reference_of_sectors))
    node = nodes["sub_aperture"]
    send = publish_sectors(graph, simulated, order)
    for count in range(1, len(order) + 1):
        send()
        graph.spin_until(lambda n=count: node.counts["in"] >= n)
    graph.spin_until(complete(nodes), 60.0)
    counts = node.state_counts()
    assert counts["sectors"] == 24
    assert (counts["sectors_repeated"], counts["sectors_out_of_order"]) == (1, 2)
    assert_same_grid(nodes["carver"], reference_of_sectors)


def test_what_is_missing_of_the_circle_is_said(
    graph: Graph, simulated: SimulatedRun, reference_of_sectors: Result, tmp_path: Path
) -> None:
    made = [sector for sector, _ in sectors_of_run(simulated.image, simulated.track, SECTOR_DEG)]
    bag = write_run(tmp_path / "hole", None, simulated.track, sectors=[*made[:4], *made[6:]])
    nodes = streaming_graph(graph, bag, 0.0, **given(reference_of_sectors))
    graph.spin_until(complete(nodes), 60.0)
    assert nodes["sub_aperture"].waiting() == "no sectors came of 60.0° to 90.0°"
    assert nodes["sub_aperture"].state_counts()["arc_deg"] == 330


@pytest.mark.parametrize("target_is_given", [False, True])  # views are due then that nobody takes
def test_a_wrong_spectrum_sign_is_named_when_the_circle_is_closed(
    graph: Graph,
    simulated: SimulatedRun,
    reference_of_sectors: Result,
    tmp_path: Path,
    target_is_given: bool,
) -> None:
    from dataclasses import replace

    acoustics = replace(simulated.image.acoustics, spectrum_sign=-1)
    image = replace(simulated.image, pixels=simulated.image.pixels, acoustics=acoustics)
    sectors = [sector for sector, _ in sectors_of_run(image, simulated.track, SECTOR_DEG)]
    bag = write_run(tmp_path / "wrong", None, simulated.track, sectors=sectors)
    target = given(reference_of_sectors) if target_is_given else {}
    node = graph.add(SubApertureNode, step_deg=STEP_DEG, **target)
    graph.add(BagPlayerNode, bag=str(bag), rate=0.0, min_sinks=1)
    said: list[Any] = []
    viewer = graph.plain_node("viewer")
    kind = RclpyMessages().cls("diagnostic_msgs/msg/DiagnosticArray")
    viewer.create_subscription(kind, "progress", lambda m: said.append(progress_from_msg(m)), qos.REPORTS)
    graph.spin_until(lambda: bool(node.error))
    assert node.error.startswith("SpectrumSignError: ")
    graph.spin_until(lambda: any("error" in item.values for item in said))
