"""Paths as navigation gives them: how many poses, where and when; serialised ones are read the same."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from csas_shadow_ros.core.geometry import Track
from msg_adapters import (
    AdapterError,
    RosbagsMessages,
    coherent_image_from_msgs,
    coherent_image_to_msgs,
    message_from_cdr,
    sector_from_msgs,
    sector_to_msgs,
    track_piece_from_msg,
    track_to_msg,
)
from msg_adapters.messages import MAX_POSES, typestore

PATH = "nav_msgs/msg/Path"
FACTORY = RosbagsMessages()


def serialised(path, *, little_endian=True):
    return bytes(typestore().serialize_cdr(path, PATH, little_endian=little_endian))


def assert_the_same(a, b):
    np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
    np.testing.assert_array_equal(a.positions_m, b.positions_m)
    assert (a.header_ns, a.notes) == (b.header_ns, b.notes)


@pytest.mark.parametrize("frame", ["csas_scene", "auv_1/scene", ""])
@pytest.mark.parametrize("poses", [1, 2, 180])
@pytest.mark.parametrize("little_endian", [True, False])
def test_a_serialised_path_reads_the_same_as_its_poses_one_by_one(track, frame, poses, little_endian):
    path = track_to_msg(FACTORY, track)
    path.poses = path.poses[:poses]
    path.header = replace(path.header, frame_id=frame or "csas_scene")
    for one in path.poses:
        one.header = replace(one.header, frame_id=frame)
    packed = message_from_cdr(serialised(path, little_endian=little_endian), PATH, "track")
    assert packed.table is not None
    assert_the_same(track_piece_from_msg(packed), track_piece_from_msg(path))
    assert packed.poses[-1].pose.position.x == path.poses[-1].pose.position.x


def test_poses_of_different_frames_are_read_one_by_one(track):
    path = track_to_msg(FACTORY, track)
    path.poses[3].header = replace(path.poses[3].header, frame_id="")
    packed = message_from_cdr(serialised(path), PATH, "track")
    assert packed.table is None
    assert_the_same(track_piece_from_msg(packed), track_piece_from_msg(path))
    path.poses[3].header = replace(path.poses[3].header, frame_id="odom_scene")  # as long as the others'
    with pytest.raises(AdapterError, match=r"track\.poses\[3\]\.header\.frame_id is 'odom_scene'"):
        track_piece_from_msg(message_from_cdr(serialised(path), PATH, "track"))


def test_a_serialised_path_names_the_pose_whose_stamp_is_no_time(track):
    path = track_to_msg(FACTORY, track)
    path.poses[7].header.stamp.nanosec = 2_000_000_000
    with pytest.raises(AdapterError, match=r"poses\[7\]\.header\.stamp is \d+ s 2000000000 ns; expected"):
        track_piece_from_msg(message_from_cdr(serialised(path), PATH, "track"))


def many(track, count):
    """Serialise a path of `count` poses, all of which but the first are the second one of a track."""
    path = track_to_msg(FACTORY, track)
    path.poses = path.poses[:2]
    pose = serialised(path)[-80:]
    path.poses = path.poses[:1]
    head = serialised(path)
    at = 4 + 8 + 4 + 12  # CDR's head, stamp, length of the frame and the frame
    assert head[at : at + 4] == b"\x01\x00\x00\x00"
    return head[:at] + count.to_bytes(4, "little") + head[at + 4 :] + pose * (count - 1)


def test_a_path_of_200_000_poses_is_read_and_one_of_too_many_refused_before_it_is_unpacked(track):
    assert message_from_cdr(many(track, 200_000), PATH, "track").table[1].shape == (200_000, 3)
    with pytest.raises(
        AdapterError, match=f"^track has {MAX_POSES + 1} poses; expected at most {MAX_POSES}$"
    ):
        message_from_cdr(many(track, MAX_POSES + 1), PATH, "track")


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (
            {"x": 1e300},
            r"^track pose 60 is at \[1e\+300, .*expected coordinates of at most 2.004e\+07 m: left",
        ),
        ({"z": float("inf")}, r"^track pose 60 is \[.*inf\]; expected finite metres: left out$"),
    ],
)
def test_a_pose_that_is_nowhere_on_earth_is_left_out_by_name(track, spoil, match):
    path = track_to_msg(FACTORY, track)
    for axis, value in spoil.items():
        setattr(path.poses[60].pose.position, axis, value)
    for one in (path, message_from_cdr(serialised(path), PATH, "track")):
        piece = track_piece_from_msg(one)
        assert len(piece.stamps_ns) == len(track) - 1
        assert len(piece.notes) == 1
        assert re.search(match, piece.notes[0])


@pytest.mark.parametrize(("pose", "seconds"), [(0, 0), (-1, 2_000_000_000)])
def test_a_pose_of_another_clock_is_left_out_and_names_no_run(track, pose, seconds):
    path = track_to_msg(FACTORY, track)
    path.poses[pose].header.stamp.sec = seconds
    piece = track_piece_from_msg(path)
    assert len(piece.stamps_ns) == len(track) - 1
    assert piece.first_ns == int(track.stamps_ns[1 if pose == 0 else 0])
    assert "is more than a day off the others" in piece.notes[0]


def test_a_pause_of_days_is_no_reason_to_leave_half_of_a_path_out(track):
    stamps = track.stamps_ns.copy()
    stamps[90:] += 3 * 86_400 * 10**9
    path = track_to_msg(FACTORY, Track(stamps, track.positions_m))
    assert track_piece_from_msg(path).notes == ()


def test_an_image_and_a_sector_that_nobody_stamped_are_refused(coherent, sector):
    for made, read in (
        (coherent_image_to_msgs(FACTORY, coherent), coherent_image_from_msgs),
        (sector_to_msgs(FACTORY, sector), sector_from_msgs),
    ):
        for message in made:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
        with pytest.raises(
            AdapterError, match=r"header\.stamp is 0; expected the time when its last data came"
        ):
            read(*made)


def test_an_image_and_a_sector_without_a_stamp_are_not_written(coherent, sector):
    for write, what, name in (
        (coherent_image_to_msgs, coherent, "image"),
        (sector_to_msgs, sector, "sector"),
    ):
        with pytest.raises(
            AdapterError, match=f"^{name} has stamp 0 ns; expected the time when its last data came$"
        ):
            write(FACTORY, replace(what, stamp_ns=0))
