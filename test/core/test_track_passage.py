"""Which poses of a track count: the circle, of the lap that a stamp names."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csas_shadow_ros.core.errors import TrackError
from csas_shadow_ros.core.geometry import DoubtfulArc, Track, passage

STEP_NS = 10**8
START_NS = 10**15


def circle(n=720, *, radius=30.0, height=12.0, start=0.0, arc=360.0, sense=1, centre=(0.0, 0.0)):
    a = np.radians(start + sense * np.arange(n) * arc / n)
    x, y = centre
    return np.c_[x + radius * np.cos(a), y + radius * np.sin(a), np.full(n, height)]


def way(n, *points):
    """Return straight ways from point to point, n poses each, without the last point."""
    points = [np.asarray(p, float) for p in points]
    return np.vstack([np.linspace(a, b, n, endpoint=False) for a, b in itertools.pairwise(points)])


def track(*parts):
    positions = np.vstack(parts)
    return Track(START_NS + STEP_NS * np.arange(len(positions)), positions)


def kept(whole, found):
    """Return the first and the last pose of each part of a track that was kept, as runs of pose numbers."""
    index = np.searchsorted(whole.stamps_ns, found.track.stamps_ns)
    return [(int(part[0]), int(part[-1])) for part in np.split(index, np.flatnonzero(np.diff(index) > 1) + 1)]


def smooth(seed, n=720, amplitude=0.5):
    """Return a random wander of rms `amplitude` (n, 3) that closes on itself."""
    rng = np.random.default_rng(seed)
    turns = np.arange(n)[:, None] * 2 * np.pi / n
    orders = np.arange(1, 7)
    waves = [np.cos(turns * orders + rng.uniform(0, 2 * np.pi, 6)) @ rng.normal(size=6) for _ in range(3)]
    wander = np.stack(waves, 1)
    return amplitude * wander / wander.std(axis=0)


C = circle()
FIRST, LAST = C[0], C[-1]
SURVEY = np.c_[np.full(400, 120.0), np.linspace(-200, 200, 400), np.full(400, 12.0)]

PLAIN = {
    "round": C,
    "clockwise": circle(sense=-1, start=77.0),
    "off centre by 3 m": circle(centre=(3.0, 1.0)),
    "off centre by a third of its radius": circle(centre=(-10.0, 5.0)),
    "an ellipse of 2:1": C * (1.33, 0.67, 1.0),
    "a spiral inwards": C * np.linspace(1.2, 1.0, 720)[:, None] ** (1, 1, 0),
    "one arc of 90 degrees": circle(180, arc=90.0, start=20.0),
    "a flat arc of an ellipse": circle(200, arc=100.0, start=45.0) * (1.15, 0.87, 1.0),
    "missing arcs": np.vstack([C[:200], C[300:500], C[560:]]),
    "370 degrees": circle(740, arc=370.0),
    "laps from the same places": np.vstack([C, C, C]),
    "poses 3 degrees apart": circle(120),
    "poses 0.05 degrees apart": circle(7200),
    "round an obstacle": C * (1 + 0.2 * np.exp(-(((np.arange(720) - 300) / 15) ** 2)))[:, None] ** (1, 1, 0),
    "settling from 2 m outside": C * (1 + 0.07 * np.exp(-np.arange(720) / 40))[:, None] ** (1, 1, 0),
    "scattered by 0.5 m": C + np.random.default_rng(1).normal(0, 0.5, C.shape),
    **{f"wandering by 0.5 m, {seed}": C + smooth(seed) for seed in range(4)},
}


@pytest.mark.parametrize("name", PLAIN)
def test_a_plain_circle_is_the_very_same_track(name):
    whole = track(PLAIN[name])
    for image_ns in (None, int(whole.stamps_ns[-1])):
        assert passage(whole, image_ns=image_ns).track is whole


@settings(max_examples=60, deadline=None)
@given(
    st.floats(5.0, 300.0),
    st.floats(0.05, 1.5),
    st.floats(0.0, 0.3),
    st.floats(0.0, 360.0),
    st.floats(60.0, 360.0),
    st.sampled_from([1, -1]),
)
def test_a_circle_of_any_size_place_and_arc_loses_no_pose(radius, high, off, start, arc, sense):
    middle = (off * radius * math.cos(start), off * radius * math.sin(start))
    poses = circle(int(2 * arc), radius=radius, height=high * radius, start=start, arc=arc, sense=sense)
    whole = track(np.add(poses, (*middle, 0.0)))
    assert passage(whole).track is whole


@settings(max_examples=150, deadline=None)
@given(
    st.floats(1.0, 1.28),
    st.floats(0.0, 180.0),
    st.floats(0.0, 360.0),
    st.floats(20.0, 130.0),
    st.sampled_from([1, -1]),
)
def test_an_ellipse_goes_on_after_a_pause_of_the_record(axes, turned, start, pause, sense):
    poses = circle(360, start=start, sense=sense) * (math.sqrt(axes), 1.0 / math.sqrt(axes), 1.0)
    c, s = math.cos(math.radians(turned)), math.sin(math.radians(turned))
    poses = poses @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    first = 170
    whole = track(np.delete(poses, np.s_[first : first + int(pause)], axis=0))
    assert passage(whole, image_ns=int(whole.stamps_ns[-1])).track is whole


@pytest.mark.parametrize("scale", [0.6, 1.7])
def test_another_circle_after_a_pause_of_the_record_is_left_out(scale):
    whole = track(circle(440, arc=220.0), circle(200, arc=100.0, start=240.0, radius=30.0 * scale))
    found = passage(whole, image_ns=int(whole.stamps_ns[439]))
    assert kept(whole, found) == [(0, 439)]
    assert "200 of 640 track poses are not on the circle" in found.notes[0]


OUTSIDE = {
    "approach": (way(180, np.add(FIRST, (270, -40, 3)), FIRST), None),
    "approach from far away": (way(2000, np.add(FIRST, (1500, -200, 8)), FIRST), None),
    "approach along the tangent": (way(800, np.add(FIRST, (0, -240, 0)), FIRST), None),
    "approach along the tangent, against the circle": (way(800, np.add(FIRST, (0, 240, 0)), FIRST), None),
    "survey line abeam": (np.vstack([SURVEY, way(200, SURVEY[-1], FIRST)]), None),
    "survey line that touches the circle": (way(300, (30, -200, 12), (30, 200, 12), FIRST), None),
    "survey line over the target": (way(401, (1e-3, -200, 12), (1e-3, 200, 12), FIRST), None),
    "lawnmower": (
        np.vstack(
            [
                way(200, (x, -200 * s, 20), (x, 200 * s, 20))
                for s, x in zip([1, -1] * 5, range(-90, 91, 20), strict=True)
            ]
            + [way(100, (90, -200, 20), FIRST)]
        ),
        None,
    ),
    "departure": (None, way(180, LAST, np.add(LAST, (-250, 30, 0)))[1:]),
    "survey line after": (None, np.vstack([way(200, LAST, SURVEY[0])[1:], SURVEY])),
    "both": (way(180, np.add(FIRST, (270, -40, 3)), FIRST), way(180, LAST, np.add(LAST, (-250, 30, 0)))[1:]),
    "a circle round another target": (
        np.vstack([circle(centre=(100.0, 0.0)), way(100, (130, 0, 12), FIRST)]),
        None,
    ),
}


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("stamped", [True, False])
def test_what_is_off_the_circle_takes_no_part(name, stamped):
    before, after = (np.empty((0, 3)) if part is None else part for part in OUTSIDE[name])
    whole = track(before, C, after)
    last = int(whole.stamps_ns[len(before) + 719])
    found = passage(whole, image_ns=last if stamped else None)
    assert kept(whole, found) == [(len(before), len(before) + 719)]
    np.testing.assert_array_equal(found.track.positions_m, C)
    assert found.track.gaps == ()
    (note,) = found.notes
    assert note.startswith(f"{len(before) + len(after)} of {len(whole)} track poses are not on the circle")
    assert "radius 30.0 m" in note


def test_an_arc_is_told_from_longer_lines_by_its_turn():
    lines = way(400, (60, -200, 12), (60, 200, 12))
    arc = circle(180, arc=90.0, start=90.0)
    whole = track(lines, way(150, lines[-1], arc[0]), arc)
    assert kept(whole, passage(whole)) == [(550, 729)]


def test_a_circle_that_is_interrupted_is_put_together():
    out = way(300, C[300], (-250, 150, 12), C[300])
    whole = track(C[:300], out, C[300:])
    found = passage(whole, image_ns=int(whole.stamps_ns[-1])).track
    assert found.gaps == ()
    off = np.abs(np.hypot(found.positions_m[:, 0], found.positions_m[:, 1]) - 30.0)
    assert off.max() < 1.5
    assert len(found) < 730


def test_standing_still_adds_no_weight():
    tilted = C.copy()
    tilted[:, 2] += 2.0 * np.cos(np.arange(720) * np.pi / 360)
    stand = tilted[300] + np.random.default_rng(0).normal(0, 0.03, (3000, 3))
    whole = track(tilted[:300], stand, tilted[300:])
    assert whole.circle[3] < 10.7
    found = passage(whole)
    assert found.track.circle[3] == pytest.approx(12.0, abs=0.01)
    assert found.track.gaps == ()
    assert "stands still for up to 30" in found.notes[0]


def test_standing_at_the_start_leaves_exactly_the_circle():
    whole = track(np.repeat(C[:1], 600, 0), C)
    assert kept(whole, passage(whole)) == [(600, 1319)]


@pytest.mark.parametrize("first", [1, 300, 718])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("by", [(8, 8, 0), (0, 0, 20), (-60, 0, 0)])
def test_poses_that_jump_are_left_out_by_name(first, count, by):
    count = min(count, 719 - first)
    poses = C.copy()
    poses[first : first + count] += by
    whole = track(poses)
    found = passage(whole)
    assert len(found.track) == 720 - count
    assert found.track.gaps == ()
    assert found.notes[0].startswith(f"track pose {first} ({whole.stamps_ns[first]} ns) at (")


@pytest.mark.parametrize("pose", [0, 719])
def test_a_first_or_last_pose_elsewhere_is_off_the_circle(pose):
    poses = C.copy()
    poses[pose] += (8, 8, 0)
    found = passage(track(poses))
    assert len(found.track) == 719
    assert found.track.gaps == ()


HIGH = np.add(C, (0, 0, 6))


@pytest.mark.parametrize(
    ("stamp", "first"),
    [(0, 0), (400, 0), (719, 0), (1000, 281), (1439, 720)],
    ids=["at its start", "in the first lap", "end of the first", "in the second", "end of the second"],
)
def test_an_image_takes_the_lap_that_ends_at_its_stamp(stamp, first):
    whole = track(C, HIGH)
    found = passage(whole, image_ns=int(whole.stamps_ns[stamp]))
    assert kept(whole, found) == [(first, first + 719)]
    assert found.track.gaps == ()
    assert "the track passes the whole circle 2 times, up to 6.0 m apart" in found.notes[0]


@pytest.mark.parametrize(("stamp", "first"), [(719, 0), (1439, 720)])
def test_a_lap_back_the_same_way_is_another_passage(stamp, first):
    whole = track(C, HIGH[::-1])
    assert kept(whole, passage(whole, image_ns=int(whole.stamps_ns[stamp]))) == [(first, first + 719)]


@pytest.mark.parametrize(("stamp", "first"), [(1000, 1), (1819, 1100)])
def test_of_two_circles_the_image_takes_its_own(stamp, first):
    whole = track(circle(1000, radius=60.0), way(100, (60, 0, 12), FIRST), C)
    found = passage(whole, image_ns=int(whole.stamps_ns[stamp - 1]))
    assert kept(whole, found)[0][0] in (first, first - 1)
    assert found.track.circle[2] == pytest.approx(60.0 if first < 2 else 30.0)


def sectors_of(whole, lap_of):
    """Return sectors of 30 degrees, each stamped in its middle, of the lap that `lap_of` names."""
    return [
        (int(whole.stamps_ns[720 * lap_of(k) + 60 * k + 30]), math.radians(30 * k), math.radians(30.0))
        for k in range(12)
    ]


@pytest.mark.parametrize("lap", [0, 1])
def test_sectors_take_the_lap_in_which_they_were_made(lap):
    whole = track(C, HIGH)
    found = passage(whole, sectors=sectors_of(whole, lambda k: lap))
    assert kept(whole, found) == [(720 * lap, 720 * lap + 719)]


def test_sectors_of_two_laps_take_each_arc_from_its_own():
    whole = track(C, HIGH)
    found = passage(whole, sectors=sectors_of(whole, lambda k: int(k > 5))).track
    assert found.gaps == ()
    for degrees in range(5, 360, 10):
        height = 12.0 if degrees < 180 else 18.0
        assert found.at_aspect(math.radians(degrees))[1][2] == pytest.approx(height)
    # The poses where the laps meet are in different places: nothing is interpolated between them.
    assert {12.0, 18.0} == {round(float(found.at_aspect(a)[1][2]), 9) for a in np.radians(range(1, 359))}


def test_without_a_stamp_aspects_that_are_passed_twice_are_refused_by_name():
    half = HIGH[:360]
    whole = track(C, half)
    found = passage(whole).track
    with pytest.raises(
        TrackError, match=r"passes aspect 12.0° 2 times, up to 6.0 m apart, and no stamp tells"
    ):
        found.at_aspect(math.radians(12.0))
    assert found.at_aspect(math.radians(200.0))[1][2] == 12.0
    assert found.covered_fraction(math.radians(90.0), math.radians(12.0)) == 0.0
    assert found.covered_fraction(math.radians(270.0), math.radians(12.0)) == 1.0
    assert math.degrees(found.coverage_rad) == pytest.approx(180.0, abs=1.0)


def test_an_arc_that_no_sector_covers_is_refused_where_laps_differ():
    whole = track(C, HIGH)
    found = passage(whole, sectors=sectors_of(whole, lambda k: 1)[:6]).track
    assert found.at_aspect(1.0)[1][2] == 18.0
    with pytest.raises(TrackError, match="no stamp tells"):
        found.at_aspect(4.0)


@pytest.mark.parametrize(("rise", "differ"), [(0.02, False), (0.05, True)])
def test_laps_differ_where_a_shadow_would(rise, differ):
    whole = track(C, C * (1, 1, 1 + rise))
    found = passage(whole)
    assert bool(found.track.doubtful) == differ
    assert (found.track is whole) != differ


def test_a_climb_over_the_circle_is_told():
    spiral = np.vstack([C, C])
    spiral[:, 2] = np.linspace(18, 12, 1440)
    whole = track(spiral)
    found = passage(whole, image_ns=int(whole.stamps_ns[-1]))
    assert kept(whole, found) == [(720, 1439)]
    assert "the track sinks from 15.0 to 12.0 m height over the circle" in found.notes[-1]


@pytest.mark.parametrize("name", ["line", "sparse", "three"])
def test_what_goes_round_nothing_is_left_as_it_is(name):
    poses = {"line": SURVEY, "sparse": circle(8), "three": circle(3, arc=1.0)}[name]
    whole = track(poses)
    assert passage(whole).track is whole


def test_a_track_knows_poses_that_are_no_neighbours():
    whole = Track(np.arange(720), C, breaks=[100])
    (gap,) = whole.gaps
    assert (math.degrees(gap.start_rad), math.degrees(gap.width_rad)) == pytest.approx((50.0, 0.5))
    with pytest.raises(TrackError, match="no pose at aspect"):
        whole.at_aspect(math.radians(50.25))
    with pytest.raises(TrackError, match="breaks are"):
        Track(np.arange(720), C, breaks=[719])


@pytest.mark.parametrize(("start", "width"), [(350.0, 20.0), (90.0, 45.0), (0.0, 360.0)])
def test_doubtful_arcs_are_gaps(start, width):
    arc = DoubtfulArc(math.radians(start), math.radians(width), 2, 6.0)
    whole = Track(np.arange(720), C, doubtful=[arc])
    assert math.degrees(whole.coverage_rad) == pytest.approx(360.0 - width)
    assert whole.covered_fraction(math.radians(start + width / 2), math.radians(min(width, 10.0))) == 0.0
