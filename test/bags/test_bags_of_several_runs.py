"""Tracks in bags as missions record them: in pieces, with more than the circle, several runs in one bag."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_bags_check import ACOUSTICS, START_NS, annulus_image, circle, only

from csas_shadow_ros import cli
from csas_shadow_ros.bags import BagWriter, check_bag, read_run
from csas_shadow_ros.bags.check import judge_coverage, judge_energy
from csas_shadow_ros.core.errors import AdapterError, BagError
from csas_shadow_ros.core.geometry import (
    CoherentImage,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.simulation.sectors import sectors_of_run
from msg_adapters import (
    RosbagsMessages,
    coherent_image_to_msgs,
    sector_to_msgs,
    track_piece_from_msg,
    track_to_msg,
    view_to_msgs,
)

FACTORY = RosbagsMessages()
SECOND_NS = 1_000_000_000
#: The second run begins an hour after the first one.
LATER = 3600 * SECOND_NS


@pytest.fixture(autouse=True)
def no_search(monkeypatch):
    """Leave out the search for shadows, which these images have none of."""
    monkeypatch.setattr("csas_shadow_ros.bags.check.check_spectrum_sign", lambda image, track: ())


def image_at(stamp_ns, seed=0):
    image = annulus_image(seed=seed)
    return CoherentImage(image.pixels, image.grid, image.acoustics, stamp_ns)


def shifted(track, by_ns, up_m=0.0):
    return Track(track.stamps_ns + by_ns, np.add(track.positions_m, (0.0, 0.0, up_m)))


def part(track, a, b):
    """Return poses a to b as a Path, stamped as its last pose."""
    return track_to_msg(FACTORY, Track(track.stamps_ns[a:b], track.positions_m[a:b]))


def bag(path, *, tracks=(), images=(), sectors=(), views=()):
    with BagWriter(path) as writer:
        for track in tracks:
            msg = track_to_msg(FACTORY, track) if isinstance(track, Track) else track
            writer.write("/csas/track", msg)
        for image in images:
            a, b = coherent_image_to_msgs(FACTORY, image)
            writer.write("/csas/camera_info", b)
            writer.write("/csas/image", a)
        for sector in sectors:
            a, b = sector_to_msgs(FACTORY, sector)
            writer.write("/csas/sector/camera_info", b)
            writer.write("/csas/sector/image", a)
        for view in views:
            a, b = view_to_msgs(FACTORY, view, "likelihood")
            writer.write("/csas/likelihood/camera_info", b)
            writer.write("/csas/likelihood/image", a)
    return path


def view(stamp_ns, degrees):
    aspect = math.radians(degrees)
    sonar = (75 * math.cos(aspect), 75 * math.sin(aspect), 18.0)
    camera = ShadowCamera.from_ground(view_ground_to_pixel(aspect, 0.02, 8, 9, (0, 0)), sonar, 8, 9)
    info = ViewInfo(stamp_ns, camera, ACOUSTICS, aspect, 0.2, (0.0, 0.0), 0.0)
    return View(info, np.full((8, 9), 0.5, np.float32))


END_NS = START_NS + 359 * SECOND_NS


@pytest.mark.parametrize(
    "cuts",
    [
        [(i, i + 100) for i in range(0, 261, 20)],
        [(i, i + 91) for i in range(0, 360, 90)],
        [(270, 360), (0, 90), (180, 270), (90, 180)],
        [(0, n) for n in range(10, 361, 50)],
    ],
    ids=["sliding", "chunks", "chunks out of order", "growing"],
)
def test_a_track_in_pieces_is_the_whole(tmp_path, cuts):
    whole = circle()
    path = bag(tmp_path / "run", tracks=[part(whole, a, b) for a, b in cuts], images=[image_at(END_NS)])
    run = read_run(path)
    np.testing.assert_array_equal(run.track.stamps_ns, whole.stamps_ns)
    np.testing.assert_array_equal(run.track.positions_m, whole.positions_m)
    assert (run.run_ns, run.run_names, run.problems) == (START_NS, (START_NS,), [])
    report = check_bag(path)
    assert report.ok
    assert {f.level for f in report.findings} == {"info"}


def test_a_path_that_grows_under_one_stamp_is_the_whole(tmp_path):
    whole = circle()
    messages = [part(whole, 0, n) for n in range(60, 361, 60)]
    for message in messages:
        message.header = messages[0].header
    run = read_run(bag(tmp_path / "run", tracks=messages, images=[image_at(END_NS)]))
    assert len(run.track) == 360
    assert run.problems == []


def test_a_survey_line_is_left_out_and_both_commands_say_so(tmp_path):
    whole = circle()
    line = np.c_[np.full(200, 250.0), np.linspace(-300, 300, 200), np.full(200, 18.0)]
    back = np.linspace(line[-1], whole.positions_m[0], 100, endpoint=False)
    positions = np.vstack([line, back, whole.positions_m])
    stamps = START_NS + SECOND_NS * (np.arange(len(positions)) - 300)
    path = bag(tmp_path / "run", tracks=[Track(stamps, positions)], images=[image_at(END_NS)])
    run = read_run(path)
    np.testing.assert_array_equal(run.track.positions_m, whole.positions_m)
    (problem,) = run.problems
    assert "300 of 660 track poses are not on the circle" in str(problem)
    report = check_bag(path)
    assert report.ok
    assert only(report, "warning").problem == problem.reason
    assert report.usable["track"] == 360


def test_sectors_name_the_lap(tmp_path):
    low = circle()
    both = Track(
        np.r_[low.stamps_ns, low.stamps_ns + 360 * SECOND_NS],
        np.vstack([low.positions_m, np.add(low.positions_m, (0.0, 0.0, 9.0))]),
    )
    sectors = [s for s, _ in sectors_of_run(image_at(END_NS), low, 30.0)]
    run = read_run(bag(tmp_path / "run", tracks=[both], sectors=sectors))
    np.testing.assert_array_equal(run.track.positions_m, low.positions_m)
    assert (
        "up to 9.0 m apart: the passage that the stamps of sectors or views name counts"
        in run.problems[0].reason
    )


def test_views_name_the_lap(tmp_path):
    low = circle()
    both = Track(
        np.r_[low.stamps_ns - 360 * SECOND_NS, low.stamps_ns],
        np.vstack([np.add(low.positions_m, (0.0, 0.0, 9.0)), low.positions_m]),
    )
    views = [view(START_NS + degrees * SECOND_NS, degrees) for degrees in range(0, 360, 6)]
    path = bag(tmp_path / "run", tracks=[both], views=views)
    track = read_run(path).track
    # The view at 0 was made at the very beginning of the lap: half of its aperture may be of the one before.
    assert {track.at_aspect(math.radians(a))[1][2] for a in range(354)} == {18.0}
    assert len(list(read_run(path).views("likelihood"))) == 60
    assert [f.level for f in check_bag(path).findings if f.topic.startswith("/csas/likelihood")] == []


@pytest.fixture
def two_runs(tmp_path):
    low = circle()
    high = shifted(low, LATER, 1.0)
    images = [image_at(END_NS, 0), image_at(END_NS + LATER, 1)]
    views = [view(START_NS + 10 * SECOND_NS, 10), view(START_NS + LATER + 20 * SECOND_NS, 20)]
    return bag(tmp_path / "two", tracks=[low, high], images=images, views=views)


@pytest.mark.parametrize(
    ("asked", "first", "degrees", "seed"),
    [
        (None, START_NS, 10, 0),
        (1, START_NS, 10, 0),
        (2, START_NS + LATER, 20, 1),
        (START_NS + LATER, START_NS + LATER, 20, 1),
    ],
)
def test_runs_of_one_bag_are_never_combined(two_runs, asked, first, degrees, seed):
    run = read_run(two_runs, run=asked)
    assert (run.run_ns, run.run_names) == (first, (START_NS, START_NS + LATER))
    assert run.track.stamps_ns[0] == first
    np.testing.assert_array_equal(run.image.pixels, annulus_image(seed=seed).pixels)
    assert [round(math.degrees(v.info.aspect_rad)) for v in run.views("likelihood")] == [degrees]
    assert run.counts == {"image": 1, "likelihood": 1}
    (problem,) = run.problems
    assert problem.reason.startswith("the bag holds 2 runs")
    assert ": 1 image, 1 likelihood); --run chooses another" in problem.reason
    report = check_bag(two_runs, run=asked)
    assert report.ok
    assert only(report, "warning").problem == problem.reason


@pytest.mark.parametrize("asked", [0, 3, START_NS + 1])
def test_a_run_that_is_not_there_is_refused_with_those_that_are(two_runs, asked, capsys):
    expected = f"there is no run {asked}; runs of this bag: 1 ({START_NS}), 2 ({START_NS + LATER})"
    with pytest.raises(BagError) as error:
        read_run(two_runs, run=asked)
    assert expected in str(error.value)
    assert expected in only(check_bag(two_runs, run=asked)).problem
    assert cli.main(["run", str(two_runs), "--out", str(two_runs) + "_out", "--run", str(asked), "-q"]) == 1
    assert expected in capsys.readouterr().err


def test_the_first_run_that_has_an_image_is_taken(tmp_path):
    low = circle()
    path = bag(tmp_path / "run", tracks=[low, shifted(low, LATER)], images=[image_at(END_NS + LATER)])
    assert read_run(path).run_ns == START_NS + LATER


def test_an_image_that_no_track_covers_is_refused_with_both_times(tmp_path):
    path = bag(tmp_path / "run", tracks=[shifted(circle(), -START_NS)], images=[image_at(END_NS)])
    with pytest.raises(
        BagError, match=rf"\({END_NS} ns\): no track covers its stamp: the track covers 0 to 359"
    ):
        read_run(path).coherent_image()
    finding = check_bag(path).findings[0]
    assert (finding.level, finding.stamp_ns) == ("error", END_NS)
    assert "no track covers its stamp" in finding.problem
    assert "one clock" in finding.remedy


def test_sectors_outside_the_run_are_passed_over_and_named_once(tmp_path):
    low = circle()
    sectors = [s for s, _ in sectors_of_run(image_at(END_NS), low, 30.0)]
    later = [s for s, _ in sectors_of_run(image_at(END_NS), shifted(low, LATER), 30.0)][:3]
    run = read_run(bag(tmp_path / "run", tracks=[low], sectors=[*sectors, *later]))
    assert len(run.sector_sum().stamps) == 12
    (problem,) = run.problems
    assert "no track covers the stamps of 3 sector messages" in problem.reason
    assert problem.reason.endswith("they are skipped")


def test_a_stamp_that_two_tracks_cover_is_told(tmp_path):
    low = circle()
    path = bag(tmp_path / "run", tracks=[low, shifted(low, 5, 9.0)], images=[image_at(END_NS)])
    run = read_run(path)
    assert len(run.run_names) == 2
    assert any("2 tracks cover its stamp, from different places" in p.reason for p in run.problems)


def spoil(index, **xyz):
    message = part(circle(), 0, 360)
    for i in index:
        for axis, value in xyz.items():
            setattr(message.poses[i].pose.position, axis, value)
    return message


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"x": math.nan}, "is [nan, "),
        ({"z": 0.0}, "is at z = 0 m"),
        ({"x": 0.0, "y": 0.0}, "over the scene's origin"),
    ],
)
def test_a_few_poses_that_cannot_be_used_are_left_out_and_named(tmp_path, values, reason):
    run = read_run(bag(tmp_path / "run", tracks=[spoil([40, 200], **values)], images=[image_at(END_NS)]))
    assert len(run.track) == 358
    assert [p.reason[:14] for p in run.problems] == ["track pose 40 ", "track pose 200"]
    assert all(reason in p.reason and p.reason.endswith("left out") for p in run.problems)


def test_more_poses_that_cannot_be_used_refuse_the_path(tmp_path):
    path = bag(tmp_path / "run", tracks=[spoil(range(40, 44), x=math.nan)], images=[image_at(END_NS)])
    run = read_run(path)
    assert run.track is None
    assert "track pose 40 is [nan, " in str(run.problems[0])
    assert "(4 of 360 poses cannot be used)" in str(run.problems[0])


@pytest.mark.parametrize(("at", "to", "lost"), [(5, 4, 5), (5, 300, 5), (0, 300, 0), (359, 3, 359)])
def test_the_pose_whose_stamp_is_out_of_order_is_the_one_that_is_left_out(at, to, lost):
    message = part(circle(), 0, 360)
    message.poses[at].header.stamp = message.poses[to].header.stamp
    piece = track_piece_from_msg(message)
    assert len(piece.stamps_ns) == 359
    assert START_NS + lost * SECOND_NS not in piece.stamps_ns
    assert f"pose {lost} (" in piece.notes[0]


def test_axes_that_point_down_are_named():
    with pytest.raises(AdapterError, match=r"pose 0 is at z = -18 m.*all poses are: is z positive downwards"):
        track_piece_from_msg(spoil(range(360), z=-18.0))


@pytest.mark.parametrize(
    ("positions", "says"),
    [
        (lambda p: np.add(p, (391234.5, 5345678.9, 0)), "map coordinates (UTM)"),
        (lambda p: np.c_[-4.49 + p[:, 0] / 74e3, 48.38 + p[:, 1] / 111e3, p[:, 2]], "degrees of latitude"),
    ],
)
def test_positions_that_do_not_go_round_the_origin_are_named(positions, says):
    track = circle()
    ((level, problem, _),) = judge_coverage(Track(track.stamps_ns, positions(track.positions_m)))
    assert (level, says in problem) == ("error", True)


@pytest.mark.parametrize("depth", [60.0, 40.0])
def test_a_depth_for_a_height_contradicts_the_band_by_name(depth):
    # 18 m above the seabed at 75 m range; cos(psi) of the depth is another.
    ((level, problem, _),) = judge_energy(annulus_image(), circle(height=depth))
    fits = float(problem.split("it fits a sonar ")[1].split(" m")[0])
    assert fits == pytest.approx(18.0, abs=4.0)
    assert f"the track has z = {depth:.1f} m" in problem
    assert level == ("error" if depth == 60.0 else "warning")


# --- navigation as vehicles log it, each in the way that a recording has it

WHOLE = circle()
FLOWN = WHOLE.positions_m


def flown(positions, first=0):
    """Return a track of these positions, of which number `first` was at the run's first moment."""
    return Track(START_NS + SECOND_NS * (np.arange(len(positions)) - first), positions)


def straight(n, a, b):
    return np.linspace(a, b, n, endpoint=False)


_LINE = np.c_[np.full(200, 250.0), np.linspace(-300, 300, 200), np.full(200, 18.0)]
_TO, _FROM = straight(150, FLOWN[0] + (270, -40, 3), FLOWN[0]), straight(151, FLOWN[-1], (-250, 30, 18))[1:]
_LINED = np.vstack([_LINE, straight(100, _LINE[-1], FLOWN[0])])
_UP = np.add(FLOWN, (0, 0, 6))
_SPIRAL = np.vstack([FLOWN, FLOWN])
_SPIRAL[:, 2] = np.linspace(24, 18, 720)


def doubled_stamp():
    message = part(WHOLE, 0, 360)
    message.poses[150].header.stamp = message.poses[149].header.stamp
    return message


def jumped():
    positions = FLOWN.copy()
    positions[150] += (8, 8, 0)
    return flown(positions)


def by_another_clock():
    return Track(WHOLE.stamps_ns - START_NS + SECOND_NS, FLOWN)


#: What is logged; the poses that are left of it; what `check` and `run` say of it, or why they refuse it.
TAKEN = {
    "approach": (flown(np.vstack([_TO, FLOWN]), 150), FLOWN, "150 of 510 track poses are not on the circle"),
    "departure": (flown(np.vstack([FLOWN, _FROM])), FLOWN, "150 of 510 track poses are not on the circle"),
    "both": (flown(np.vstack([_TO, FLOWN, _FROM]), 150), FLOWN, "300 of 660 track poses are not on"),
    "survey line": (flown(np.vstack([_LINED, FLOWN]), 300), FLOWN, "300 of 660 track poses are not on"),
    "survey line after": (
        flown(np.vstack([FLOWN, straight(100, FLOWN[-1], _LINE[0])[1:], _LINE])),
        FLOWN,
        "299 of 659 track poses are not on the circle",
    ),
    "a lap 6 m higher before": (flown(np.vstack([_UP, FLOWN]), 360), FLOWN, "whole circle 2 times, up to"),
    "a lap 6 m higher after": (flown(np.vstack([FLOWN, _UP])), FLOWN, "whole circle 2 times, up to 6.0 m"),
    "a spiral": (flown(_SPIRAL, 360), _SPIRAL[360:], "the track sinks from 21.0 to 18.0 m height"),
    "standing at the start": (
        flown(np.vstack([np.repeat(FLOWN[:1], 300, 0), FLOWN]), 300),
        FLOWN,
        "the sonar stands still for up to 306.0 s: 300 of 660 track poses",
    ),
    "two poses of one stamp": (doubled_stamp(), np.delete(FLOWN, 150, 0), "out of order: pose 150 "),
    "a pose without a fix": (spoil([150], x=math.nan), np.delete(FLOWN, 150, 0), "track pose 150 is [nan"),
    "a pose 8 m off": (jumped(), np.delete(FLOWN, 150, 0), "track pose 150 "),
}
REFUSED = {
    "z down": (spoil(range(360), z=-18.0), "is z positive downwards"),
    "depth for height": (flown(FLOWN * (1, 1, 0) + (0, 0, 60)), "above the seabed, not a depth?"),
    "UTM": (flown(np.add(FLOWN, (391234.5, 5345678.9, 0))), "map coordinates (UTM)"),
    "degrees": (flown(np.c_[FLOWN[:, 0] / 74e3, 48.38 + FLOWN[:, 1] / 111e3, FLOWN[:, 2]]), "degrees of lat"),
    "another frame": (Track(WHOLE.stamps_ns, FLOWN, frame="map"), "is in frame 'map', the image in"),
    "by another clock": (by_another_clock(), "no track covers its stamp"),
}


@pytest.mark.parametrize("name", TAKEN)
def test_navigation_that_holds_more_than_the_circle_leaves_the_circle_and_is_told_by_both(tmp_path, name):
    logged, left, told = TAKEN[name]
    path = bag(tmp_path / "run", tracks=[logged], images=[image_at(END_NS)])
    run = read_run(path)
    np.testing.assert_array_equal(run.track.positions_m, left)
    report = check_bag(path)
    assert report.ok, str(report)
    warned = [f.problem for f in report.findings if f.level == "warning"]
    assert any(told in text for text in warned), warned
    # Nothing that `check` warns of is unknown to `run`.
    assert {p.reason for p in run.problems} >= set(warned)


@pytest.mark.parametrize("name", REFUSED)
def test_navigation_of_other_axes_units_frames_or_clocks_is_refused_by_both(tmp_path, capsys, name):
    logged, told = REFUSED[name]
    path = bag(tmp_path / "run", tracks=[logged], images=[image_at(END_NS)])
    report = check_bag(path)
    assert not report.ok
    assert any(told in f.problem for f in report.findings if f.level == "error"), str(report)
    assert cli.main(["run", str(path), "--out", str(tmp_path / "out"), "-q"]) == 1
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_odometry_on_the_topic_of_the_track_is_refused_by_both_with_both_types(tmp_path, capsys):
    path = tmp_path / "run"
    with BagWriter(path) as writer:
        for name, message in zip(
            ("image", "camera_info"), coherent_image_to_msgs(FACTORY, image_at(END_NS)), strict=True
        ):
            writer.write(f"/csas/{name}", message)
        writer.write("/csas/track", b"\0\1\0\0" + bytes(720), END_NS, type_name="nav_msgs/msg/Odometry")
    told = "its type is 'nav_msgs/msg/Odometry'; expected nav_msgs/msg/Path"
    assert told in [f.problem for f in check_bag(path).findings]
    assert cli.main(["run", str(path), "--out", str(tmp_path / "out"), "-q"]) == 1
    assert told in capsys.readouterr().err
