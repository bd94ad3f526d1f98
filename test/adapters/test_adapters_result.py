"""What a run leaves, and what it carves, on topics: back to the last digit, and what is refused."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.bags import BagReader
from csas_shadow_ros.core.pipeline import Result as PipelineResult
from csas_shadow_ros.core.search.bodies import SignEvidence
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.shape.mesh import Dimensions, measure, mesh_from_grid
from csas_shadow_ros.core.shape.result import LeftOut, ObjectResult, Quality, Result, ViewEvidence
from csas_shadow_ros.core.shape.seabed import SeabedSlope
from csas_shadow_ros.core.shape.volume import Target, Volume, VoxelGrid
from csas_shadow_ros.results.bag import ResultBag
from msg_adapters import (
    AdapterError,
    RosbagsMessages,
    decision_from_msg,
    decision_to_msg,
    evidence_from_msg,
    evidence_to_msg,
    measurements_from_msg,
    measurements_to_msg,
    objects_from_msg,
    objects_to_msg,
    result_from_msgs,
    result_to_msgs,
    topic,
    type_name_of,
    voxel_grid_from_msgs,
)
from msg_adapters.messages import message_from_cdr, typestore

STAMP_NS = 1_700_000_000_123_456_789
RUN_NS = STAMP_NS - 987_654_321
THIRD = 1.0 / 3.0  # has no short decimal


def carried(msg):
    """Send a message through the wire of its own world."""
    name = type_name_of(msg)
    if hasattr(msg, "__msgtype__"):
        return typestore().deserialize_cdr(typestore().serialize_cdr(msg, name), name)
    serialization = pytest.importorskip("rclpy.serialization")
    return serialization.deserialize_message(serialization.serialize_message(msg), type(msg))


def a_grid(seed, position=(0.1, -0.2), method="consensus", threshold=0.1 + 0.2, seabed=None):
    # 0.1 / 0.3 and the like: P holds quotients that do not read back to the last digit.
    volume = Volume.around(position, (0.55, 0.4, 0.3), 0.05 + seed / 70.0)
    rng = np.random.default_rng(seed)
    likelihood = rng.random(volume.shape, dtype=np.float32)
    likelihood[-1, 0] = np.nan
    inner = np.zeros(volume.shape, bool)
    inner[:-1, 1:-1, 1:-1] = True
    likelihood[inner] *= np.float32(0.2)
    views = rng.integers(0, 65536, volume.shape).astype(np.uint16)
    return VoxelGrid(volume, likelihood, views, threshold, inner, method, seabed)


def dimensions(seed, mesh, intervals=True):
    rng = np.random.default_rng(seed)
    measured = replace(measure(mesh), hull_top_m=THIRD if intervals else math.nan)
    if not intervals:
        return measured
    names = ("length_m", "width_m", "height_m", "volume_m3", "heading_rad", "position_x_m", "position_y_m")
    return replace(measured, intervals={name: tuple(sorted(rng.standard_normal(2))) for name in names})


def an_object(number):
    grid = a_grid(number, (2.0 + THIRD, -1.0), seabed=None if number == 2 else SLOPE)
    mesh = mesh_from_grid(grid)
    target = Target((2.0 + THIRD, -1.0), (0.5, 0.4, THIRD), 0.1 * number, stands=number == 2)
    return ObjectResult(target, grid, mesh, dimensions(number, mesh, number == 2), 17 + number)


SLOPE = SeabedSlope((0.02 * THIRD, -1e-3), 1e-4 * THIRD, (0.1, -0.2))


def evidence_of(n):
    views = {
        STAMP_NS - 1000 * i: ViewEvidence(
            STAMP_NS - 1000 * i,
            THIRD * i,
            (75.0 * THIRD, -60.1, 18.3),
            0.7 * THIRD,
            9.0 + i,
            bool(i % 2),
            0.41,
            shift_m=-0.02 * THIRD * i,
        )
        for i in range(n)
    }
    views[7] = ViewEvidence(7, -2.2, (1.0, 2.0, 3.0))
    return views


def whole_result():
    grid = a_grid(1, seabed=SLOPE)
    mesh = mesh_from_grid(grid)
    matter = grid.occupied.copy()
    matter[1, 3:5, 3:5] = False
    hollowed = mesh_from_grid(replace(grid, likelihood=np.where(matter, grid.likelihood, 1), occupied=matter))
    return Result(
        run_ns=RUN_NS,
        stamp_ns=STAMP_NS,
        final=False,
        verdict="object",
        quality=Quality("limited", ("the arc covers 100 of 360 degrees", "contrast is low: 2.1")),
        target=Target((0.1, -0.2), (0.55, 0.4, 0.3), math.nan, stands=False),
        sign=SignEvidence(-1, 4.5 * THIRD, 0.0),
        grid=grid,
        other_grid=a_grid(4, method="soft", threshold=math.nan),
        mesh=mesh,
        dimensions=dimensions(5, mesh),
        matter=matter,
        matter_mesh=hollowed,
        views_used=117,
        arc_rad=100.0 * THIRD / 57.0,
        evidence=evidence_of(5),
        further=[an_object(2), an_object(3)],
        left_out=[
            LeftOut((THIRD, -4.0), "it hangs over the seabed; no shadow reaches it"),
            LeftOut((1.0, 2.0), "x", strong=True),
        ],
    )


def without_hollow():
    result = whole_result()
    result.matter, result.matter_mesh = result.grid.occupied.copy(), result.mesh
    return result


def one_plain_object():
    result = whole_result()
    result.matter = result.matter_mesh = result.other_grid = result.sign = result.run_ns = None
    result.further, result.left_out, result.evidence = [], [], {}
    result.dimensions = dimensions(5, result.mesh, intervals=False)
    result.quality, result.final = Quality(), True
    return result


def carved_and_nothing_left():
    grid = a_grid(1, threshold=math.nan)
    grid = replace(
        grid, occupied=np.zeros_like(grid.occupied), likelihood=np.full_like(grid.likelihood, np.nan)
    )
    target = Target((0.1, -0.2), (0.55, 0.4, 0.3))
    return Result(stamp_ns=STAMP_NS, verdict="undecided", target=target, grid=grid, further=[an_object(2)])


def empty_surface():
    result = one_plain_object()
    result.mesh, result.further = trimesh.Trimesh(), [replace(an_object(2), mesh=trimesh.Trimesh())]
    return result


RESULTS = {
    "everything": whole_result,
    "no hollow": without_hollow,
    "one object without intervals": one_plain_object,
    "nothing to carve": lambda: Result(stamp_ns=STAMP_NS, left_out=[LeftOut((0.0, 1.0), "too small")]),
    "nothing left of the target": carved_and_nothing_left,
    "empty surface": empty_surface,
    "before the first view": Result,
}


def assert_same(ours, theirs, where="result"):
    """Compare to the last digit; NaN is NaN, and meshes are their triangles."""
    if isinstance(ours, trimesh.Trimesh):
        assert isinstance(theirs, trimesh.Trimesh), where
        np.testing.assert_array_equal(theirs.vertices[theirs.faces], ours.vertices[ours.faces], where)
    elif isinstance(ours, np.ndarray):
        assert (theirs.dtype, theirs.shape) == (ours.dtype, ours.shape), where
        np.testing.assert_array_equal(theirs, ours, where)
    elif is_dataclass(ours):
        assert type(theirs) is type(ours), where
        for one in fields(ours):
            assert_same(getattr(ours, one.name), getattr(theirs, one.name), f"{where}.{one.name}")
    elif isinstance(ours, dict):
        assert list(theirs) == list(ours), where
        for key in ours:
            assert_same(ours[key], theirs[key], f"{where}[{key}]")
    elif isinstance(ours, (list, tuple)):
        assert (type(theirs), len(theirs)) == (type(ours), len(ours)), where
        for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(a, b, f"{where}[{i}]")
    elif isinstance(ours, float) and math.isnan(ours):
        assert math.isnan(theirs), where
    else:
        assert theirs == ours, where


def sent(factory, result, **how):
    return {name: carried(msg) for name, msg in result_to_msgs(factory, result, **how)}


# --- the whole result


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_survives_serialised_messages_to_the_last_digit(factory, name):
    result = RESULTS[name]()
    assert_same(result, result_from_msgs(sent(factory, result)))


def test_the_lattice_is_exact_though_a_camera_holds_it_to_rounding(factory):
    result = one_plain_object()
    volume = replace(result.grid.volume, origin_m=(12.1 + THIRD, -7.7, 0.0245), voxel_size_m=0.049)
    messages = sent(factory, replace(result, grid=replace(result.grid, volume=volume)))
    _, rounded, _ = voxel_grid_from_msgs(messages["voxel_grid/image"], messages["voxel_grid/camera_info"])
    assert rounded != volume  # else this test shows nothing
    assert result_from_msgs(messages).grid.volume == volume


def test_without_a_hollow_the_surface_of_the_matter_is_the_mesh(factory):
    messages = sent(factory, without_hollow())
    assert messages["matter/mesh"].action == 2
    back = result_from_msgs(messages)
    assert back.matter_mesh is back.mesh


def test_every_message_of_a_result_is_of_its_topics_type_and_carries_the_stamp_asked_for(factory):
    messages = sent(factory, whole_result(), stamp_ns=STAMP_NS + 5)
    for name, msg in messages.items():
        assert type_name_of(msg) == topic(name).type_name
        if name != "objects":
            assert msg.header.stamp.nanosec == (STAMP_NS + 5) % 1_000_000_000
    assert {"object_3/voxel_grid/image", "object_2/mesh", "other_method/voxels", "matter/image"} <= set(
        messages
    )
    assert result_from_msgs(messages).stamp_ns == STAMP_NS


def test_what_nobody_wants_is_not_made_but_the_figures_are(factory):
    names = [name for name, _ in result_to_msgs(factory, whole_result(), wanted=lambda t: t == "mesh")]
    assert names == ["mesh", "objects", "evidence", "measurements"]


def test_objects_that_are_gone_are_taken_away(factory):
    messages = sent(factory, one_plain_object(), before=3)
    for number in (2, 3):
        assert messages[f"object_{number}/mesh"].action == 2
        assert messages[f"object_{number}/voxels"].width == 0
    gone = [(m.ns, m.id) for m in messages["objects"].markers if m.action == 2]
    assert gone == [("objects", 2), ("labels", 2), ("objects", 3), ("labels", 3)]
    assert not result_from_msgs(messages).further


def test_what_is_left_of_an_earlier_result_is_not_taken_for_this_ones(factory):
    old = sent(factory, whole_result())
    new = sent(factory, Result(stamp_ns=STAMP_NS + 9))
    assert_same(Result(stamp_ns=STAMP_NS + 9), result_from_msgs(old | new))


def test_messages_of_two_results_are_not_combined(factory):
    old = sent(factory, whole_result())
    new = sent(factory, replace(whole_result(), stamp_ns=STAMP_NS + 9))
    with pytest.raises(
        AdapterError, match=r"voxels is stamped \d+789 ns; expected the stamp of measurements, "
    ):
        result_from_msgs(new | {"voxels": old["voxels"]})


@pytest.mark.parametrize(
    "lost",
    ["measurements", "evidence", "voxel_grid/image", "mesh", "matter/camera_info", "object_2/voxels"],
)
def test_a_message_that_is_missing_is_named(factory, lost):
    messages = sent(factory, whole_result())
    del messages[lost]
    with pytest.raises(AdapterError, match=f"there is no message of {lost}; expected one"):
        result_from_msgs(messages)


def test_a_cloud_or_an_image_on_another_lattice_is_refused(factory):
    messages = sent(factory, whole_result())
    with pytest.raises(AdapterError, match=r"voxels has \d+ of \d+ points off the lattice, the first at 0 "):
        result_from_msgs(messages | {"voxels": messages["object_3/voxels"]})
    other = {
        f"voxel_views/{kind}": messages[f"object_3/voxel_views/{kind}"] for kind in ("image", "camera_info")
    }
    with pytest.raises(
        AdapterError, match=r"voxel_views/camera_info has voxels of .*; expected those of meas"
    ):
        result_from_msgs(messages | other)


def test_a_fraction_of_a_view_is_refused(factory):
    result = one_plain_object()
    messages = sent(factory, replace(result, grid=replace(result.grid, views=result.grid.views + 0.5)))
    with pytest.raises(AdapterError, match=r"voxel_views has up to .* views; expected whole numbers"):
        result_from_msgs(messages)


@pytest.mark.parametrize("name", ["everything", "nothing to carve"])
def test_the_bag_of_a_results_folder_holds_the_result_on_the_graphs_topics(tmp_path, name):
    result = RESULTS[name]()
    path = ResultBag(tmp_path).finish(result)
    reader = BagReader(path)
    messages = {
        m.topic.removeprefix("/csas/"): message_from_cdr(m.cdr, m.type_name, m.topic)
        for m in reader.messages()
    }
    expected = {topic for topic, _ in result_to_msgs(RosbagsMessages(), result)} | {"target"}
    assert set(messages) == expected
    # A bag without views has no stamp to give its messages but zero; the newest view stays as it was.
    assert_same(result, result_from_msgs(messages))


def test_the_bag_takes_what_the_pipeline_leaves_in_this_process_too(tmp_path):
    ours = whole_result()
    theirs = PipelineResult(
        **{one.name: getattr(ours, one.name) for one in fields(PipelineResult) if hasattr(ours, one.name)}
    )
    reader = BagReader(ResultBag(tmp_path).finish(theirs))
    back = result_from_msgs(
        {
            m.topic.removeprefix("/csas/"): message_from_cdr(m.cdr, m.type_name, m.topic)
            for m in reader.messages()
        }
    )
    for name in ("grid", "other_grid", "mesh", "matter", "matter_mesh", "dimensions", "further", "left_out"):
        assert_same(getattr(ours, name), getattr(back, name), name)


# --- measurements


def status_of(msg, name):
    (found,) = [s for s in msg.status if s.name == name]
    return found


def values_of(status):
    return {v.key: v.value for v in status.values}


def set_value(msg, name, key, value):
    status = status_of(msg, name)
    for pair in status.values:
        if pair.key == key:
            pair.value = value
            return
    raise KeyError(key)


def drop_value(msg, name, key):
    status = status_of(msg, name)
    status.values = [v for v in status.values if v.key != key]


def test_measurements_say_by_fixed_names_what_outside_readers_look_for(factory):
    result = whole_result()
    msg = measurements_to_msg(factory, result)
    run, first = (values_of(status_of(msg, name)) for name in ("run", "object 1"))
    assert run["verdict"] == "object"
    assert run["quality"] == "limited"
    assert run["reasons"] == "the arc covers 100 of 360 degrees; contrast is low: 2.1"
    assert int(run["run"]) == RUN_NS
    assert float(run["arc_deg"]) == math.degrees(result.arc_rad)
    assert int(run["views"]) == 117
    assert float(first["length_m"]) == result.dimensions.length_m
    for key in ("length_m", "width_m", "height_m", "volume_m3", "heading_rad", "x_m", "y_m"):
        low, high = result.dimensions.intervals[{"x_m": "position_x_m", "y_m": "position_y_m"}.get(key, key)]
        assert (float(first[f"{key}.low"]), float(first[f"{key}.high"])) == (low, high)
    assert msg.header.stamp.sec == STAMP_NS // 1_000_000_000


def test_the_volumes_of_matter_and_hollow_are_those_of_their_voxels(factory):
    result = whole_result()
    told = measurements_from_msg(measurements_to_msg(factory, result))
    voxel = result.grid.volume.voxel_size_m**3
    assert told.matter_volume_m3 == pytest.approx(result.matter.sum() * voxel)
    assert told.hollow_volume_m3 == pytest.approx(4 * voxel)


def test_an_interval_that_there_is_not_is_left_out(factory):
    first = values_of(status_of(measurements_to_msg(factory, one_plain_object()), "object 1"))
    assert not [key for key in first if key.endswith((".low", ".high"))]
    assert first["hull_top_m"] == "nan"


@pytest.mark.parametrize(
    ("quality", "level"), [("good", 0), ("limited", 1), ("not trustworthy", 2)], ids=lambda v: str(v)
)
def test_the_level_is_the_quality(factory, quality, level):
    msg = measurements_to_msg(factory, replace(whole_result(), quality=Quality(quality, ("why",))))
    for name in ("run", "object 1", "object 3"):
        found = status_of(msg, name).level
        assert (found[0] if isinstance(found, bytes) else found) == level


def test_the_messages_of_the_statuses_read_as_lines(factory):
    result = one_plain_object()
    d = Dimensions(1.2171, 0.5549, 0.455, 0.1, 0.0, (0.0, 0.0))
    msg = measurements_to_msg(factory, replace(result, dimensions=d, quality=Quality("limited", ("a", "b"))))
    assert status_of(msg, "object 1").message == "1.217 x 0.555 x 0.455 m, heading 0.0 deg"
    assert status_of(msg, "run").message == "object, limited: a; b"


def test_a_semicolon_in_a_reason_does_not_make_it_two(factory):
    result = replace(whole_result(), quality=Quality("limited", ("one; still one", "two")))
    assert measurements_from_msg(measurements_to_msg(factory, result)).quality.reasons == (
        "one, still one",
        "two",
    )


def test_a_further_object_keeps_its_number_where_nothing_is_left_of_the_target(factory):
    msg = measurements_to_msg(factory, carved_and_nothing_left())
    assert [s.name for s in msg.status] == ["run", "object 2"]


def test_values_and_statuses_that_are_not_known_are_passed_over(factory):
    msg = measurements_to_msg(factory, whole_result())
    before = measurements_from_msg(msg)
    more = measurements_to_msg(factory, whole_result()).status[0]
    more.name = "weather"
    pair = factory.make("diagnostic_msgs/msg/KeyValue", key="latitude_deg", value="54.3")
    low = factory.make("diagnostic_msgs/msg/KeyValue", key="latitude_deg.low", value="54.2")
    for status in msg.status:
        status.values = [*status.values, pair, low]
    msg.status = [*msg.status, more]
    assert_same(before, measurements_from_msg(msg))


def rename(old, new):
    def change(msg):
        status_of(msg, old).name = new

    return change


def value(name, key, text):
    return lambda msg: set_value(msg, name, key, text)


def drop(name, key):
    return lambda msg: drop_value(msg, name, key)


def frame(name):
    def change(msg):
        msg.header.frame_id = name

    return change


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (rename("run", "walk"), r"measurements\.status has 'walk', 'object 1', .*; expected one .* 'run'"),
        (
            rename("object 3", "object 2"),
            r"status\[3\]\.name is 'object 2' again; expected one status a name",
        ),
        (rename("object 3", "object 65"), r"measurements has an object 65; expected at most 64"),
        (
            value("run", "verdict", "maybe"),
            r"status 'run': verdict is 'maybe'; expected one of: object, no o",
        ),
        (value("run", "quality", "fine"), r"status 'run': quality is 'fine'; expected one of: good, limited"),
        (value("run", "final", "yes"), r"status 'run': final is 'yes'; expected one of: true, false"),
        (
            value("run", "views", "many"),
            r"status 'run': views is 'many'; expected a whole number of at least 0",
        ),
        (value("run", "run", "-1"), r"status 'run': run is '-1'; expected a whole number"),
        (value("run", "sign", "2"), r"status 'run': sign is '2'; expected one of: 1, -1"),
        (value("run", "voxel_size_m", "0.0"), r"voxel_size_m is '0\.0'; expected more than 0 m"),
        (value("object 1", "length_m", "long"), r"status 'object 1': length_m is 'long'; expected a number"),
        (
            value("object 2", "target_size_y_m", "-1"),
            r"'object 2': target_size_y_m is '-1'; expected more than 0",
        ),
        (
            value("object 2", "target_x_m", "nan"),
            r"'object 2': target_x_m is 'nan'; expected a finite number",
        ),
        (
            drop("object 1", "height_m"),
            r"status 'object 1': height_m is missing; expected it among the values",
        ),
        (drop("object 1", "height_m.low"), r"status 'object 1': height_m\.low is missing"),
        (drop("other method", "method"), r"status 'other method': method is missing"),
        (drop("left out 1", "y_m"), r"status 'left out 1': y_m is missing"),
        (frame(""), r"measurements\.header\.frame_id is ''; expected the name of the scene's frame"),
    ],
)
def test_malformed_measurements_are_refused_by_status_and_value(factory, spoil, match):
    msg = measurements_to_msg(factory, whole_result())
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        measurements_from_msg(msg)


def test_a_verdict_a_quality_or_an_interval_that_there_is_not_is_not_written(factory):
    result = whole_result()
    with pytest.raises(AdapterError, match=r"the result's verdict is 'maybe'; expected one of: object"):
        measurements_to_msg(factory, replace(result, verdict="maybe"))
    with pytest.raises(AdapterError, match=r"the result's quality is 'bad'; expected one of: good"):
        measurements_to_msg(factory, replace(result, quality=Quality("bad")))
    strange = replace(result.dimensions, intervals={"colour": (0.0, 1.0)})
    with pytest.raises(AdapterError, match=r"there is an interval of 'colour'; expected of: length_m"):
        measurements_to_msg(factory, replace(result, dimensions=strange))
    with pytest.raises(AdapterError, match=r"64 further objects; expected at most 63"):
        measurements_to_msg(factory, replace(result, further=[result.further[0]] * 64))


# --- objects


def test_objects_are_boxes_on_the_seabed_turned_as_they_lie(factory):
    result = whole_result()
    found = objects_from_msg(carried(objects_to_msg(factory, result)))
    assert [number for number, _ in found] == [1, 2, 3]
    for (_, box), one in zip(found, result.objects, strict=True):
        d = one.dimensions
        assert (box.position_m, box.size_m) == (d.position_m, (d.length_m, d.width_m, d.height_m))
        assert box.heading_rad == pytest.approx(d.heading_rad, abs=1e-12)


def test_a_box_stands_on_the_seabed_and_its_label_tells_its_figures_above_it(factory):
    d = Dimensions(1.2171, 0.5549, 0.455, 0.1, math.pi / 2, (3.0, -4.0), intervals={"length_m": (1.2, 1.24)})
    cube, label = objects_to_msg(factory, replace(one_plain_object(), dimensions=d)).markers
    assert (cube.ns, cube.id, cube.type, cube.action) == ("objects", 1, 1, 0)
    assert (label.ns, label.id, label.type, label.action) == ("labels", 1, 9, 0)
    assert cube.pose.position.z == 0.455 / 2
    q = cube.pose.orientation
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0, 0, math.sqrt(0.5), math.sqrt(0.5)))
    assert label.pose.position.z > 0.455
    assert label.text.splitlines() == [
        "object 1",
        "1.217 ± 0.020 x 0.555 x 0.455 m",
        "heading 90.0 deg",
        "volume 0.100 m³",
    ]


def cube(**changes):
    def change(msg):
        for name, new in changes.items():
            setattr(msg.markers[0], name, new)

    return change


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (cube(type=2), r"objects\.markers\[0\]\.type is 2; expected 1 \(CUBE\)"),
        (cube(action=7), r"objects\.markers\[0\]\.action is 7; expected 0 \(ADD\)"),
        (cube(id=0), r"objects\.markers\[0\]\.id is 0; expected a number of its own, from 1"),
        (cube(id=2), r"objects\.markers\[2\]\.id is 2; expected a number of its own"),
        (
            lambda m: setattr(m.markers[0].pose.orientation, "x", 0.5),
            r"orientation is \(0\.5, .* turn about z",
        ),
        (
            lambda m: setattr(m.markers[0].scale, "y", 0.0),
            r"markers\[0\]\.scale is .*; expected length, width",
        ),
        (
            lambda m: setattr(m.markers[0].pose.position, "x", math.nan),
            r"position is .*; expected finite metres",
        ),
        (lambda m: frame("")(m.markers[0]), r"markers\[0\]\.header\.frame_id is ''"),
    ],
)
def test_malformed_objects_are_refused_by_field(factory, spoil, match):
    msg = objects_to_msg(factory, whole_result())
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        objects_from_msg(msg)


def test_an_object_that_is_nowhere_or_has_no_size_is_not_written(factory):
    result = one_plain_object()
    for d in (
        replace(result.dimensions, width_m=0.0),
        replace(result.dimensions, position_m=(math.nan, 0.0)),
    ):
        with pytest.raises(AdapterError, match=r"object 1 is .*; expected finite numbers, and sizes > 0 m"):
            objects_to_msg(factory, replace(result, dimensions=d))


# --- evidence


def test_evidence_survives_to_the_last_digit_and_a_status_is_named_by_its_views_stamp(factory):
    evidence = evidence_of(4)
    msg = carried(evidence_to_msg(factory, evidence, STAMP_NS))
    assert [s.name for s in msg.status] == [str(stamp) for stamp in evidence]
    assert float(values_of(msg.status[1])["aspect_deg"]) == math.degrees(THIRD)
    assert_same(evidence, evidence_from_msg(msg))


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (rename("7", "seven"), r"evidence has a status named 'seven'; expected a view's stamp in ns"),
        (
            value("7", "sonar_z_m", "inf"),
            r"evidence, status '7': sonar_z_m is 'inf'; expected a finite number",
        ),
        (value("7", "estimated", "1"), r"status '7': estimated is '1'; expected one of: true, false"),
        (drop("7", "contrast"), r"status '7': contrast is missing"),
        (frame(""), r"evidence\.header\.frame_id is ''"),
    ],
)
def test_malformed_evidence_is_refused_by_view_and_value(factory, spoil, match):
    msg = evidence_to_msg(factory, evidence_of(2), STAMP_NS)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        evidence_from_msg(msg)


# --- search

TARGETS = (
    Target((THIRD, -0.2), (0.5, 0.4, 0.3), 1.0 / 7.0, stands=True),
    Target((5.0, 6.0), (0.1, THIRD, 0.3), math.nan, stands=False),
    Target((-5.0, 6.0), (0.1, 0.2, 0.3), 1e-300),
)
DECISIONS = {
    "several": Decision(
        TARGETS[0],
        TARGETS[1:],
        (LeftOut((1.0, THIRD), "too many; 4 are carved"),),
        SignEvidence(1, THIRD, 2e-9),
        others_step_rad=THIRD,
    ),
    "one": Decision(TARGETS[1]),
    "none": Decision(None, sign=SignEvidence(-1, 0.0, 0.0)),
    "no target but another": Decision(None, TARGETS[1:2]),
}


@pytest.mark.parametrize("name", DECISIONS)
@pytest.mark.parametrize(("run_ns", "may_move"), [(RUN_NS, True), (None, False)])
def test_a_decision_survives_to_the_last_digit(factory, name, run_ns, may_move):
    decision = replace(DECISIONS[name], frame="csas_scene")
    msg = carried(decision_to_msg(factory, decision, STAMP_NS, run_ns, STAMP_NS - 1, may_move))
    news = decision_from_msg(msg)
    assert (news.stamp_ns, news.run_ns, news.target_stamp_ns) == (STAMP_NS, run_ns, STAMP_NS - 1)
    assert news.may_move is may_move
    assert_same(decision, news.decision)


def test_the_target_is_body_one_and_its_place_and_size_have_names(factory):
    msg = decision_to_msg(factory, DECISIONS["several"], STAMP_NS, RUN_NS, STAMP_NS)
    assert [s.name for s in msg.status] == ["run", "body 1", "body 2", "body 3", "left out 1"]
    body = values_of(msg.status[1])
    assert list(body) == ["x_m", "y_m", "size_x_m", "size_y_m", "size_z_m", "evidence", "stands"]
    assert float(body["x_m"]) == THIRD
    assert msg.status[4].message == "too many; 4 are carved"
    assert values_of(msg.status[0])["run"] == str(RUN_NS)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (rename("run", "sun"), r"search\.status has 'sun', .*; expected one that is named 'run'"),
        (drop("run", "target"), r"search, status 'run': target is missing"),
        (value("run", "others_step_rad", "inf"), r"others_step_rad is 'inf'; expected a finite number"),
        (value("run", "may_move", ""), r"status 'run': may_move is ''; expected one of: true, false"),
        (value("body 2", "size_x_m", "0"), r"status 'body 2': size_x_m is '0'; expected more than 0 m"),
        (value("body 1", "stands", "no"), r"status 'body 1': stands is 'no'; expected one of: true, false"),
        (drop("body 1", "evidence"), r"status 'body 1': evidence is missing"),
    ],
)
def test_a_malformed_decision_is_refused_by_status_and_value(factory, spoil, match):
    msg = decision_to_msg(factory, DECISIONS["several"], STAMP_NS, RUN_NS, STAMP_NS)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        decision_from_msg(msg)


def test_another_type_of_message_is_refused(factory):
    image = factory.make("sensor_msgs/msg/Image")
    for read in (measurements_from_msg, evidence_from_msg, decision_from_msg, objects_from_msg):
        with pytest.raises(AdapterError, match=r"is a sensor_msgs/msg/Image; expected"):
            read(image)
