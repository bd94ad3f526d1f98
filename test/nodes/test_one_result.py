"""Whoever feeds the views, the numbers are the same: run, replay, live, sectors, views of a stage."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from csas_shadow_ros.bags import BagReader
from csas_shadow_ros.core.geometry import Datum
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.run_bag import process_bag, replay_bag
from csas_shadow_ros.simulation.bag import simulate_bag
from csas_shadow_ros.simulation.targets import box, cylinder, join_bodies
from msg_adapters import TOPICS, measurements_from_msg, objects_from_msg, topic
from msg_adapters.topics import RESULT_TOPICS, split_prefix

COARSE = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=10.0), carving=CarvingParameters(voxel_size_m=0.04)
)


def two_bodies() -> Any:
    """A box, and a piece of a cylinder 1.2 m from it."""
    bodies = box(0.5, 0.3, 0.3), cylinder(0.4, 0.25)
    for body, x in zip(bodies, (-0.6, 0.6), strict=True):
        body.apply_translation([x, 0.1 * x, 0.0])
    return join_bodies(bodies)


SCENES = {
    "box": ("tiny", lambda: "box", 3),
    "two bodies": ("small", two_bodies, 5),
    "frame": ("small", lambda: "frame_grid", 1),
}


DATUM = Datum(48.3829, -4.4953, altitude_m=-42.0, covariance_m2=(4.0, 2.25, -0.5))


@dataclass(frozen=True)
class Told:
    """What a run says, as its report has it."""

    report: dict[str, Any]
    folder: Path

    @property
    def answers(self) -> dict[str, Any]:
        """Everything that must be the same, to the last digit."""
        r = self.report
        # Not every bag of views holds the truth.
        left = ("files", "truth")
        objects = [{k: v for k, v in one.items() if k not in left} for one in r["objects"]]
        return {
            "verdict": r["verdict"],
            "quality": r["quality"],
            "dimensions": r["dimensions"],
            "objects": objects,
            "left_out": r["objects_left_out"],
            "slope": r["seabed_slope"],
            "hollows": r["hollows"] and {k: r["hollows"][k] for k in ("voxels", "volume_m3")},
            "grid": r["grid"],
            "target": r["target"],
            "frame": r["frame"],
            "datum": r["datum"],
        }

    def grid(self, name: str) -> Any:
        return np.load(self.folder / "grid.npz")[name]


@pytest.fixture(
    scope="module",
    params=[
        pytest.param("box", marks=pytest.mark.xdist_group("told of a box")),
        pytest.param("two bodies", marks=pytest.mark.xdist_group("told of two bodies")),
        pytest.param("frame", marks=[pytest.mark.long, pytest.mark.xdist_group("told of a frame")]),
    ],
)
def told(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Told]:
    """One scene, told in five ways."""
    profile, target, seed = SCENES[request.param]
    folder = tmp_path_factory.mktemp("told")
    bag, sectors = folder / "bag", folder / "sectors"
    # One scene has a name and a place of its own.
    place: dict[str, Any] = {"datum": DATUM, "frame": "auv_1/scene"} if request.param == "box" else {}
    simulate_bag(bag, profile, target(), seed=seed, **place)
    simulate_bag(sectors, profile, target(), seed=seed, sectors_deg=30.0, **place)
    found: dict[str, Told] = {}

    def tell(name: str, make: Any, source: Path, **options: Any) -> None:
        out = folder / "results" / name.replace(" ", "_")
        make(source, out, COARSE, figures=False, **options)
        found[name] = Told(json.loads((out / "report.json").read_text()), out)

    tell("run", process_bag, bag)
    tell("replay", replay_bag, bag)
    tell("sectors", process_bag, sectors)
    tell("sectors through the graph", replay_bag, sectors)
    tell("shadow views", process_bag, found["replay"].folder / "result.mcap", start_from="shadow")
    return found


def test_every_way_says_the_same_to_the_last_digit(told: dict[str, Told]) -> None:
    expected = told["run"]
    for name, one in told.items():
        for array in ("likelihood", "occupied", "views", "matter"):
            assert np.array_equal(one.grid(array), expected.grid(array), equal_nan=True), (name, array)
        assert one.answers == expected.answers, name


def test_the_last_live_message_says_what_the_report_says(told: dict[str, Told]) -> None:
    for way in ("replay", "run"):
        with BagReader(told[way].folder / "result.mcap") as reader:
            last = {m.topic.rpartition("/csas/")[2]: m.decode() for m in reader.messages()}
        measured = measurements_from_msg(last["measurements"])
        report = told["run"].report
        assert measured.final
        assert measured.verdict == report["verdict"]
        assert measured.quality.verdict == report["quality"]["verdict"]
        assert [one.dimensions.length_m for one in measured.objects] == [
            one["dimensions"]["length_m"] for one in report["objects"]
        ]
        intervals = report["dimensions"]["intervals"]
        assert {k: list(v) for k, v in measured.objects[0].dimensions.intervals.items()} == intervals
        boxes = dict(objects_from_msg(last["objects"]))
        assert len(boxes) == len(report["objects"])
        assert boxes[1].size_m[0] == report["dimensions"]["length_m"]


def test_where_on_earth_objects_are_is_told_in_the_report_and_on_topics(told: dict[str, Told]) -> None:
    report = told["replay"].report
    if report["datum"] is None:
        assert {one["place"] for one in report["objects"]} == {None}
        return
    datum = Datum(**{k: tuple(v) if isinstance(v, list) else v for k, v in report["datum"].items()})
    assert datum == DATUM
    with BagReader(told["replay"].folder / "result.mcap") as reader:
        last = {m.topic.rpartition("/csas/")[2]: m.decode() for m in reader.messages()}
    (one,) = report["objects"]
    place = one["place"]
    latitude, longitude = DATUM.to_latlon(*one["dimensions"]["position_m"])
    assert (place["latitude_deg"], place["longitude_deg"]) == (latitude, longitude)
    assert place["sigma_east_m"] > 2.0
    values = {v.key: v.value for s in last["measurements"].status if s.name == "object 1" for v in s.values}
    assert {name: float(values[name]) for name in place} == place
    transform = last["scene_transform"]
    assert (transform.header.frame_id, transform.child_frame_id) == ("earth", "auv_1/scene")
    # Of the diagnostics of the nodes nobody says where they are.
    framed = {name: m.header.frame_id for name, m in last.items() if hasattr(m, "header")}
    others = {name: frame for name, frame in framed.items() if frame != "auv_1/scene"}
    assert set(others) <= {"progress", "/diagnostics", "scene_transform"}, others
    assert f"place: {latitude:.7f}° N" in (told["replay"].folder / "summary.txt").read_text()


def test_the_graph_publishes_everything_that_a_results_folder_holds(told: dict[str, Told]) -> None:
    """Of the replay's bag, which is what its nodes published, nothing is missing that the run's bag has."""
    replayed, ran = (told[way].folder / "result.mcap" for way in ("replay", "run"))
    with BagReader(replayed) as graph, BagReader(ran) as run:
        published = {name.removeprefix("/csas/") for name, info in graph.topics.items() if info.count}
        written = {name.removeprefix("/csas/") for name, info in run.topics.items() if info.count}
    assert written <= published
    assert set(RESULT_TOPICS) <= published
    assert all(topic(name) for name in published if not name.startswith("/"))
    assert {"search", "target", "progress"} <= published
    unprefixed = {name for name in published if not split_prefix(name)[0]}
    assert unprefixed <= set(TOPICS)


def test_a_replay_computes_nothing_again(told: dict[str, Told]) -> None:
    timings = told["replay"].report["timings_s"]
    assert not {"views", "shape", "hollows", "objects"} & set(timings)
