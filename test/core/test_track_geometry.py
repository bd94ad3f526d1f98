"""Tracks: which aspects they cover, and where the sonar was when."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from core_data import HEIGHT_M, RADIUS_M, circle_track
from hypothesis import given, settings
from hypothesis import strategies as st

from csas_shadow_ros.core.errors import ParameterError, TrackError
from csas_shadow_ros.core.geometry import Track, unit_to_sonar, wrap_angle


def track_at(degrees, **kwargs):
    a = np.radians(degrees)
    return Track(
        np.arange(len(a)) * 10**9, np.c_[30 * np.cos(a), 30 * np.sin(a), np.full(len(a), 12.0)], **kwargs
    )


def brute_covered(track, points):
    """Say which aspects lie between two neighbouring poses at most max_gap apart (or in the closing step)."""
    a = track.aspects_rad
    pairs = list(pairwise(a))
    closing = float(wrap_angle(a[0] - a[-1]))
    if abs(a[-1] - a[0]) > math.pi:
        pairs.append((a[-1], a[-1] + closing))
    covered = np.zeros(len(points), bool)
    for first, second in pairs:
        if abs(second - first) <= track.max_gap_rad:
            covered |= np.mod(points - min(first, second), 2 * math.pi) <= abs(second - first)
    return covered


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("start_deg", [0.0, 123.4, -77.0, 359.75])
@pytest.mark.parametrize("n", [720, 361, 121])
def test_a_full_circle_has_no_gap_whichever_way_it_runs(clockwise, start_deg, n):
    track = circle_track(n, clockwise=clockwise, start_deg=start_deg)
    assert track.gaps == ()
    assert track.coverage_rad == pytest.approx(2 * math.pi)
    assert track.covered_fraction(1.0, 0.2) == 1.0


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("start_deg", [0.0, 50.0, 300.0])
def test_a_missing_arc_is_the_gap(clockwise, start_deg):
    track = circle_track(clockwise=clockwise, start_deg=start_deg, keep=lambda d: not 80 < d < 110)
    (gap,) = track.gaps
    assert math.degrees(gap.start_rad) == pytest.approx(80.0)
    assert math.degrees(gap.width_rad) == pytest.approx(30.0)
    assert str(gap) == "80.0° to 110.0°"
    assert math.degrees(track.coverage_rad) == pytest.approx(330.0)


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_gap_across_zero_degrees_is_one_gap(clockwise):
    track = circle_track(clockwise=clockwise, start_deg=200.0, keep=lambda d: 20 <= d <= 350)
    (gap,) = track.gaps
    assert math.degrees(gap.start_rad) == pytest.approx(350.0)
    assert math.degrees(gap.width_rad) == pytest.approx(30.0)


def test_half_a_circle_is_not_closed():
    track = circle_track(keep=lambda d: d <= 180)
    (gap,) = track.gaps
    assert math.degrees(gap.start_rad) == pytest.approx(180.0)
    assert math.degrees(gap.width_rad) == pytest.approx(180.0)


def test_poses_too_far_apart_cover_nothing():
    track = track_at(np.arange(0, 360, 10.0))
    (gap,) = track.gaps
    assert gap.width_rad == pytest.approx(2 * math.pi)
    assert track.coverage_rad == pytest.approx(0.0)
    assert track_at(np.arange(0, 360, 10.0), max_gap_rad=math.radians(10.1)).gaps == ()


steps = st.lists(st.sampled_from([-4.0, -0.7, 0.9, 1.3, 2.6, 2.9, 3.1, 7.0, 40.0]), min_size=6, max_size=60)


@settings(max_examples=150)
@given(st.floats(0, 360), steps, st.floats(0, 360), st.floats(2.0, 90.0))
def test_covered_fraction_is_what_counting_finds(start_deg, steps_deg, aspect_deg, width_deg):
    track = track_at(start_deg + np.r_[0.0, np.cumsum(steps_deg)])
    points = np.radians(aspect_deg) + np.radians(width_deg) * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    expected = brute_covered(track, points).mean()
    assert track.covered_fraction(math.radians(aspect_deg), math.radians(width_deg)) == pytest.approx(
        expected, abs=2e-3
    )


@settings(max_examples=100)
@given(st.floats(0, 360), steps)
def test_coverage_is_what_counting_finds(start_deg, steps_deg):
    track = track_at(start_deg + np.r_[0.0, np.cumsum(steps_deg)])
    points = 2 * math.pi * (np.arange(20000) + 0.5) / 20000
    assert track.coverage_rad / (2 * math.pi) == pytest.approx(brute_covered(track, points).mean(), abs=2e-3)


@settings(max_examples=100)
@given(st.floats(0, 360), steps, st.floats(0, 360))
def test_at_aspect_answers_exactly_where_the_track_covers(start_deg, steps_deg, aspect_deg):
    track = track_at(start_deg + np.r_[0.0, np.cumsum(steps_deg)])
    aspect = math.radians(aspect_deg)
    near = brute_covered(track, aspect + np.array([-1e-6, 0.0, 1e-6]))
    if near.all():
        _, position = track.at_aspect(aspect)
        seen = math.atan2(position[1], position[0])
        assert abs(float(wrap_angle(seen - aspect))) < math.radians(0.05)
    elif not near.any() and np.abs(wrap_angle(track.aspects_rad - aspect)).min() > 1e-6:
        with pytest.raises(TrackError, match=r"no pose at aspect"):
            track.at_aspect(aspect)


def test_an_arc_that_wraps_round_covers_the_beginning_of_the_circle_too():
    track = track_at([0.0, -4.0, -1.1, 1.8, -2.2, 0.9, 0.2])
    assert track.covered_fraction(0.0, math.radians(2.0)) == pytest.approx(1.0)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("aspect_deg", [0.0, 0.25, 33.3, 180.0, 359.9, -90.0, 725.0])
def test_at_aspect_interpolates_time_and_place(clockwise, aspect_deg):
    track = circle_track(clockwise=clockwise, start_deg=10.0)
    stamp, position = track.at_aspect(math.radians(aspect_deg))
    assert position[:2] == pytest.approx(RADIUS_M * unit_to_sonar(math.radians(aspect_deg)), abs=1e-3)
    assert position[2] == pytest.approx(HEIGHT_M)
    along = (10.0 - aspect_deg) % 360.0 if clockwise else (aspect_deg - 10.0) % 360.0
    assert stamp == pytest.approx(along / 0.5 * 1e9, abs=2e6)


def test_at_aspect_follows_the_real_track_not_the_nominal_circle():
    a = np.radians(np.arange(0, 361, 0.5))
    height = 12 + np.sin(3 * a)
    radius = 30 + 2 * np.cos(2 * a)
    track = Track(np.arange(len(a)) * 10**9, np.c_[radius * np.cos(a), radius * np.sin(a), height])
    _, position = track.at_aspect(math.radians(40.2))
    assert np.hypot(*position[:2]) == pytest.approx(30 + 2 * math.cos(math.radians(80.4)), abs=1e-3)
    assert position[2] == pytest.approx(12 + math.sin(math.radians(120.6)), abs=1e-3)


def test_at_aspect_of_a_wobbling_track_is_the_first_passage():
    track = track_at([0.0, 1.0, 2.0, 1.5, 1.0, 2.0, 3.0, 4.0])
    stamp, position = track.at_aspect(math.radians(1.6))
    assert stamp == pytest.approx(1.6e9, abs=1e6)
    assert math.degrees(math.atan2(position[1], position[0])) == pytest.approx(1.6, abs=1e-3)


@pytest.mark.parametrize("direction", [1, -1])
def test_where_a_track_of_more_than_a_turn_begins_its_first_passage_is_its_first_pose(direction):
    track = track_at(direction * np.arange(0, 400.5, 0.5))
    stamp, _ = track.at_aspect(0.0)
    assert stamp == 0


def test_a_pose_right_after_a_gap_can_be_asked_for():
    track = track_at(np.r_[np.arange(0, 30.5, 0.5), np.arange(60, 200.5, 0.5)])
    for aspect_deg, index in ((30.0, 60), (60.0, 61)):
        stamp, _ = track.at_aspect(float(track.aspects_rad[index]))
        assert stamp == index * 10**9, aspect_deg


def test_no_position_is_made_up_inside_a_gap():
    track = circle_track(keep=lambda d: not 80 < d < 110)
    with pytest.raises(TrackError, match=r"no pose at aspect 95.00°"):
        track.at_aspect(math.radians(95.0))
    with pytest.raises(TrackError, match=r"no pose at aspect 95.00°"):
        track.at_aspect(math.radians(95.0 + 720.0))


def test_the_circle_and_grazing_angle_are_those_of_the_poses():
    a = np.radians(np.arange(0, 300, 1.0))
    track = Track(np.arange(len(a)), np.c_[30 * np.cos(a) + 0.5, 30 * np.sin(a) - 0.2, np.full(len(a), 12.0)])
    assert track.circle == pytest.approx((0.5, -0.2, 30.0, 12.0))
    assert circle_track().grazing_rad == pytest.approx(math.atan2(12.0, 30.0))


GOOD = np.array([[30.0, 0, 12], [0, 30, 12], [-30, 0, 12], [0, -30, 12]])


def changed(row, value):
    out = GOOD.copy()
    out[row] = value
    return out


@pytest.mark.parametrize(
    ("stamps", "positions", "match"),
    [
        ([0, 1], GOOD[:2], "track has 2 poses; expected at least 3"),
        ([], np.empty((0, 3)), "track has 0 poses"),
        ([0, 1, 2], GOOD, r"stamps \(3,\) and positions \(4, 3\)"),
        ([0, 1, 2, 3], GOOD[:, :2], r"positions \(4, 2\); expected \(n,\), \(n, 3\)"),
        ([0, 1, 1, 3], GOOD, r"pose 2 \(1 ns\) is not after pose 1 \(1 ns\)"),
        ([0, 5, 2, 3], GOOD, r"pose 2 \(2 ns\) is not after pose 1 \(5 ns\)"),
        ([0, 1, 2, 3], changed(2, (math.nan, 0, 12)), "track pose 2 is"),
        ([0, 1, 2, 3], changed(1, (0, math.inf, 12)), "track pose 1 is"),
        ([0, 1, 2, 3], changed(3, (0, -30, 0)), "track pose 3 is at z = 0 m; expected above the seabed"),
        ([0, 1, 2, 3], changed(3, (0, -30, -4)), "track pose 3 is at z = -4 m"),
        ([0, 1, 2, 3], changed(1, (0, 0, 12)), "track pose 1 is over the scene's origin"),
    ],
)
def test_a_malformed_track_is_refused_with_the_pose_and_its_value(stamps, positions, match):
    with pytest.raises(TrackError, match=match):
        Track(stamps, positions)


@pytest.mark.parametrize("value", [0.0, -1.0, 4.0, math.nan])
def test_a_longest_gap_out_of_bounds_is_refused(value):
    with pytest.raises(ParameterError, match="max_gap_rad is"):
        Track([0, 1, 2, 3], GOOD, max_gap_rad=value)


def test_a_track_cannot_be_changed_after_it_was_checked():
    track = circle_track()
    with pytest.raises(ValueError, match="read-only"):
        track.positions_m[0, 2] = -5.0
