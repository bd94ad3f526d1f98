"""Track, voxels, mesh, target, progress: round trips, and what is refused."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from msg_adapters import (
    AdapterError,
    Heartbeat,
    Level,
    RclpyMessages,
    RosbagsMessages,
    TargetBox,
    ViewProgress,
    is_routine_report,
    mesh_from_msg,
    mesh_to_msg,
    message_from_cdr,
    progress_from_msg,
    progress_to_msg,
    target_from_msg,
    target_to_msg,
    track_from_msg,
    track_to_msg,
    type_name_of,
    voxels_from_msg,
    voxels_to_msg,
)
from msg_adapters.messages import typestore

# --- track


def test_a_track_survives_the_round_trip_to_the_last_bit(factory, track):
    msg = track_to_msg(factory, track)
    assert msg.header.frame_id == "csas_scene"
    back = track_from_msg(msg)
    np.testing.assert_array_equal(back.stamps_ns, track.stamps_ns)
    np.testing.assert_array_equal(back.positions_m, track.positions_m)


def test_orientations_of_a_track_are_not_used(factory, track):
    msg = track_to_msg(factory, track)
    for pose in msg.poses:
        pose.pose.orientation.w = float("nan")
    np.testing.assert_array_equal(track_from_msg(msg).positions_m, track.positions_m)


def test_a_wide_gap_is_passed_on_and_not_filled(factory, track):
    msg = track_to_msg(factory, track)
    msg.poses = msg.poses[:60] + msg.poses[75:]
    (gap,) = track_from_msg(msg).gaps
    assert np.degrees(gap.width_rad) == pytest.approx(32.0)


def unstamp(msg):
    for pose in msg.poses:
        pose.header.stamp.sec, pose.header.stamp.nanosec = 0, 0


def pose(i, **xyz):
    def change(msg):
        for axis, value in xyz.items():
            setattr(msg.poses[i].pose.position, axis, value)

    return change


def swap(msg):
    msg.poses[7], msg.poses[8] = msg.poses[8], msg.poses[7]


def repeat(msg):
    msg.poses = [*msg.poses, msg.poses[-1]]


def cut(n):
    def change(msg):
        msg.poses = msg.poses[:n]

    return change


def frame(name, i=None):
    def change(msg):
        (msg if i is None else msg.poses[i]).header.frame_id = name

    return change


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (frame(" "), r"track\.header\.frame_id is ' '; expected the name of the scene's frame"),
        (frame("odom", 3), r"track\.poses\[3\]\.header\.frame_id is 'odom'; expected 'csas_scene'"),
        (unstamp, r"track\.poses: no pose is stamped"),
        (cut(0), r"track\.poses: track has 0 poses; expected at least 3"),
        (cut(2), r"track\.poses: track has 2 poses"),
        (swap, r"track\.poses: track stamps are out of order: pose 8 "),
        (repeat, r"track\.poses: track stamps are out of order: pose 180 "),
        (pose(5, z=-18.0), r"track\.poses: track pose 5 is at z = -18 m; expected above the seabed"),
        (pose(5, x=float("nan")), r"track\.poses: track pose 5 is \[nan, .*expected finite metres"),
        (pose(5, x=0.0, y=0.0), r"track\.poses: track pose 5 is over the scene's origin"),
    ],
)
def test_a_malformed_track_is_refused_and_the_pose_is_named(factory, track, spoil, match):
    msg = track_to_msg(factory, track)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        track_from_msg(msg)


# --- voxels


@pytest.fixture
def grid():
    volume = Volume((-0.35, 1.25, 0.05), 0.1, (3, 4, 5))
    rng = np.random.default_rng(0)
    likelihood = rng.random(volume.shape, dtype=np.float32)
    likelihood[0, 0, 0] = np.nan
    views = rng.integers(0, 360, volume.shape).astype(np.uint16)
    return VoxelGrid(volume, likelihood, views, 0.4, likelihood < 0.4)


def test_voxels_survive_the_round_trip(factory, grid):
    voxels = voxels_from_msg(voxels_to_msg(factory, grid, 42))
    iz, iy, ix = np.nonzero(grid.occupied)
    expected = np.column_stack([grid.volume.x_m[ix], grid.volume.y_m[iy], grid.volume.z_m[iz]])
    assert voxels.stamp_ns == 42
    np.testing.assert_array_equal(voxels.points_m, expected.astype(np.float32))
    np.testing.assert_array_equal(voxels.l_out, grid.likelihood[iz, iy, ix])
    np.testing.assert_array_equal(voxels.views, grid.views[iz, iy, ix])


def test_no_voxels_are_an_empty_cloud(factory, grid):
    nothing = np.zeros(grid.volume.shape, bool)
    assert voxels_from_msg(voxels_to_msg(factory, grid, 42, nothing)).points_m.shape == (0, 3)
    with pytest.raises(AdapterError, match=r"choice has shape \(1,\); expected \(3, 4, 5\)"):
        voxels_to_msg(factory, grid, 42, np.zeros(1, bool))


def test_a_big_endian_cloud_with_more_fields_and_padded_rows_reads_the_same(grid):
    factory = RosbagsMessages()
    n = int(grid.occupied.sum())
    ours = voxels_from_msg(voxels_to_msg(factory, grid, 42))
    layout = np.dtype(
        {
            "names": ["views", "z", "rgb", "y", "x", "l_out"],
            "formats": [">u4", ">f4", ">u4", ">f4", ">f4", ">f4"],
            "offsets": [0, 4, 8, 12, 16, 20],
            "itemsize": 28,
        }
    )
    points = np.zeros(n, layout)
    points["x"], points["y"], points["z"] = ours.points_m.T
    points["l_out"], points["views"] = ours.l_out, ours.views
    data = np.zeros((n, 30), np.uint8)  # one point a row, two bytes of padding
    data[:, :28] = points.view(np.uint8).reshape(n, 28)
    codes = {"f": 7, "u": 6}
    msg = factory.make(
        "sensor_msgs/msg/PointCloud2",
        header=factory.make("std_msgs/msg/Header", frame_id="csas_scene"),
        height=n,
        width=1,
        fields=[
            factory.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=layout.fields[name][1],
                datatype=codes[layout[name].kind],
                count=1,
            )
            for name in layout.names
        ],
        is_bigendian=True,
        point_step=28,
        row_step=30,
        data=data.reshape(-1),
    )
    theirs = voxels_from_msg(msg)
    np.testing.assert_array_equal(theirs.points_m, ours.points_m)
    np.testing.assert_array_equal(theirs.l_out, ours.l_out)
    np.testing.assert_array_equal(theirs.views, ours.views)


def cloud_field(i, **fields):
    def change(msg):
        for name, value in fields.items():
            setattr(msg.fields[i], name, value)

    return change


def cloud(**fields):
    def change(msg):
        for name, value in fields.items():
            setattr(msg, name, value)

    return change


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (cloud_field(3, name="intensity"), r"voxels\.fields lacks 'l_out'; expected x, y, z, l_out, views"),
        (cloud_field(0, datatype=8), r"x has datatype 8 \(f8\); expected f4"),
        (cloud_field(4, datatype=7), r"views has datatype 7 \(f4\); expected u2 or u4"),
        (cloud_field(4, offset=19), r"views ends at byte 21; expected inside point_step, 20"),
        (cloud_field(1, count=3), r"y has count 3; expected 1"),
        (cloud(row_step=3), r"voxels\.row_step is 3 bytes; expected"),
        (cloud(height=2), r"voxels\.data has \d+ bytes; expected row_step \* height"),
        (frame(""), r"voxels\.header\.frame_id is ''"),
    ],
)
def test_a_malformed_cloud_is_refused(factory, grid, spoil, match):
    msg = voxels_to_msg(factory, grid, 42)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        voxels_from_msg(msg)


def test_a_voxel_that_is_nowhere_is_refused(factory, grid):
    nowhere = VoxelGrid(grid.volume, grid.likelihood, grid.views, 0.4, grid.occupied)
    msg = voxels_to_msg(factory, nowhere, 42)
    raw = np.frombuffer(bytes(msg.data), np.uint8).copy()
    raw[20:24] = np.frombuffer(np.float32(np.nan).tobytes(), np.uint8)
    msg.data = factory.octets(raw)
    with pytest.raises(AdapterError, match=r"voxels has 1 of \d+ points not finite, the first at 1 "):
        voxels_from_msg(msg)


# --- mesh and target


def test_a_mesh_survives_the_round_trip_closed_and_in_place(factory):
    mesh = trimesh.creation.box(extents=(0.8, 0.4, 0.3))
    mesh.apply_translation((1.0, -2.0, 0.15))
    msg = mesh_to_msg(factory, mesh, 42)
    assert (msg.type, msg.action, len(msg.points)) == (11, 0, 36)
    back = mesh_from_msg(msg)
    assert back.is_watertight
    np.testing.assert_array_equal(back.bounds, mesh.bounds)
    assert back.volume == pytest.approx(mesh.volume, rel=1e-12)


@pytest.mark.parametrize("mesh", [None, trimesh.Trimesh()])
def test_no_mesh_takes_the_marker_away(factory, mesh):
    msg = mesh_to_msg(factory, mesh, 42)
    assert msg.action == 2
    assert mesh_from_msg(msg) is None


def test_scale_and_position_of_a_marker_count(factory):
    msg = mesh_to_msg(factory, trimesh.creation.box(extents=(1, 1, 1)), 42)
    msg.scale.x, msg.pose.position.z = 2.0, 0.5
    np.testing.assert_allclose(mesh_from_msg(msg).bounds, [[-1, -0.5, 0], [1, 0.5, 1]])


def turned(msg):
    msg.pose.orientation.z = 0.7


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (cloud(type=1), r"mesh\.type is 1; expected 11 \(TRIANGLE_LIST\)"),
        (cloud(action=7), r"mesh\.action is 7; expected 0 \(ADD\)"),
        (frame(""), r"mesh\.header\.frame_id is ''"),
        (turned, r"mesh\.pose\.orientation is \(0, 0, 0\.7, 1\)"),
        (
            lambda m: setattr(m, "points", m.points[:-1]),
            r"mesh\.points has 35 points; expected three a triangle",
        ),
        (lambda m: setattr(m, "points", []), r"mesh\.points has 0 points"),
        (lambda m: setattr(m.points[4], "y", float("inf")), r"mesh\.points\[4\] is .*; expected finite"),
    ],
)
def test_a_malformed_mesh_is_refused(factory, spoil, match):
    msg = mesh_to_msg(factory, trimesh.creation.box(extents=(1, 1, 1)), 42)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        mesh_from_msg(msg)


def test_the_carved_box_survives_and_its_absence_too(factory):
    volume = Volume.around((1.0, -2.0), (2.0, 1.0, 0.5), 0.05)
    box = TargetBox.of(volume)
    assert target_from_msg(target_to_msg(factory, box, 42)) == box
    assert target_from_msg(target_to_msg(factory, None, 42)) is None


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (cloud(type=11), r"target\.type is 11; expected 1 \(CUBE\)"),
        (lambda m: setattr(m.scale, "y", 0.0), r"target\.scale is .*; expected x, y, z > 0 m"),
        (lambda m: setattr(m.scale, "y", float("nan")), r"target\.scale is .*; expected finite metres"),
        (
            lambda m: setattr(m.pose.position, "x", float("inf")),
            r"target\.pose\.position is .*; expected finite",
        ),
        (turned, r"target\.pose\.orientation"),
    ],
)
def test_a_malformed_box_is_refused(factory, spoil, match):
    msg = target_to_msg(factory, TargetBox((0, 0, 1), (1, 1, 2)), 42)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        target_from_msg(msg)


def test_a_box_without_size_is_not_written(factory):
    with pytest.raises(AdapterError, match=r"target size is \(1, 0, 1\)"):
        target_to_msg(factory, TargetBox((0, 0, 0), (1, 0, 1)), 42)


# --- progress

PROGRESS = [
    ViewProgress(7, "carver", "a1", "integrated", values={"aspect_deg": "12"}),
    ViewProgress(7, "sub_aperture", "b2", "published"),
    ViewProgress.rejected(7, "carver", "a1", "shadow leaves the image: 90 % unknown"),
    ViewProgress.rejected(7, "carver", "a1", "broken", Level.ERROR),
    Heartbeat(9, "carver", "a1", "sink", {"in": 12, "rejected": 3}),
    Heartbeat(9, "player", "c3", "source"),
]


@pytest.mark.parametrize("item", PROGRESS)
def test_progress_and_heartbeats_survive_the_round_trip(factory, item):
    assert progress_from_msg(progress_to_msg(factory, item)) == item


@pytest.mark.parametrize("item", PROGRESS)
def test_only_what_went_well_with_a_view_is_routine(item):
    serialization = pytest.importorskip("rclpy.serialization")
    cdr = serialization.serialize_message(progress_to_msg(RclpyMessages(), item))
    went_well = isinstance(item, ViewProgress) and item.outcome != "rejected"
    assert is_routine_report(cdr) == went_well


def test_a_rejected_view_is_no_ok_status(factory):
    status = progress_to_msg(factory, PROGRESS[2]).status[0]
    assert status.level in (1, b"\x01")
    assert (status.name, status.hardware_id) == ("carver", "a1")
    assert status.message == "rejected: shadow leaves the image: 90 % unknown"


def status(**fields):
    def change(factory, msg):
        for name, value in fields.items():
            setattr(msg.status[0], name, value)

    return change


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda f, m: setattr(m, "status", []), r"progress\.status has 0 entries; expected 1"),
        (status(message="done"), r"outcome is 'done'; expected integrated, published or rejected"),
        (status(message="rejected"), r"reason of a view rejected is ''"),
        (status(message="heartbeat"), r"role is ''; expected one of: source, stage, sink"),
        (lambda f, m: setattr(m.status[0], "level", f.octet(9)), r"status\[0\]\.level is 9; expected 0 to 3"),
    ],
)
def test_malformed_progress_is_refused(factory, spoil, match):
    msg = progress_to_msg(factory, PROGRESS[1])
    spoil(factory, msg)
    with pytest.raises(AdapterError, match=match):
        progress_from_msg(msg)


def test_a_count_that_is_no_number_is_refused(factory):
    msg = progress_to_msg(factory, PROGRESS[4])
    msg.status[0].values[1].value = "many"
    with pytest.raises(AdapterError, match=r"count\.in is 'many'; expected a count"):
        progress_from_msg(msg)


@given(
    reason=st.text(min_size=1, max_size=30),
    counts=st.dictionaries(st.text(max_size=8), st.integers(-(2**62), 2**62), max_size=4),
)
def test_any_reason_and_any_counts_survive(reason, counts):
    factory = RosbagsMessages()
    view = ViewProgress.rejected(1, "n", "i", reason)
    beat = Heartbeat(1, "n", "i", "stage", counts)
    assert progress_from_msg(progress_to_msg(factory, view)) == view
    assert progress_from_msg(progress_to_msg(factory, beat)) == beat


# --- the two worlds


@pytest.mark.parametrize("type_name", ["sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2"])
def test_pixels_go_into_a_message_without_a_copy(type_name):
    pytest.importorskip("rclpy")
    factory = RclpyMessages()
    data = factory.octets(np.arange(7, dtype=np.uint8))
    message = factory.make(type_name, data=data, height=1)
    assert message.data is data
    assert (message.height, list(message.data)) == (1, list(range(7)))
    assert factory.make(type_name, data=data)._check_fields == factory.make(type_name)._check_fields


def test_pixels_of_a_serialised_message_are_read_where_they_lie():
    kind = "sensor_msgs/msg/Image"
    image = RosbagsMessages().make(kind, data=np.arange(64, dtype=np.uint8), height=1)
    cdr = bytes(typestore().serialize_cdr(image, kind))
    message = message_from_cdr(cdr, kind, "image")
    assert np.array_equal(message.data, image.data)
    assert np.shares_memory(message.data, np.frombuffer(cdr, np.uint8))


def test_messages_of_both_worlds_tell_their_type(factory):
    for name in ("sensor_msgs/msg/Image", "diagnostic_msgs/msg/DiagnosticArray"):
        assert type_name_of(factory.make(name)) == name


def test_an_unknown_type_or_field_is_refused_by_name():
    with pytest.raises(AdapterError, match="message type sonar_msgs/msg/Ping is unknown"):
        RosbagsMessages().make("sonar_msgs/msg/Ping")
    with pytest.raises(AdapterError, match="has no field 'colour'; expected one of: data"):
        RosbagsMessages().make("std_msgs/msg/String", colour="red")


def test_every_contract_message_has_its_defaults_in_rosbags():
    pytest.importorskip("rclpy")
    from rclpy.serialization import serialize_message

    from msg_adapters import TOPICS, RclpyMessages
    from msg_adapters.messages import typestore

    for name in {t.type_name for t in TOPICS.values()}:
        theirs, ours = RclpyMessages().make(name), RosbagsMessages().make(name)
        back = typestore().deserialize_cdr(serialize_message(theirs), name)
        assert typestore().serialize_cdr(back, name) == typestore().serialize_cdr(ours, name)


WITHOUT_ROS = """
import importlib, pkgutil, sys
for name in ("rclpy", "sensor_msgs", "nav_msgs", "std_msgs", "rosidl_runtime_py"):
    sys.modules[name] = None
import csas_shadow_ros.core, csas_shadow_ros.bags, msg_adapters
count = 0
for package in (csas_shadow_ros.core, csas_shadow_ros.bags, msg_adapters):
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
        count += 1
from msg_adapters import RclpyMessages, AdapterError
try:
    RclpyMessages().make("sensor_msgs/msg/Image")
except AdapterError as error:
    print(count, error)
"""


def test_core_adapters_and_bags_import_without_ros_and_say_so_when_it_is_needed():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_ROS], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    count, _, message = done.stdout.strip().partition(" ")
    assert int(count) > 25
    assert message.startswith("message type sensor_msgs/msg/Image is not installed")
