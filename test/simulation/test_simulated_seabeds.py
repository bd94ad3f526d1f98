"""Seabeds with levels and relief, bodies of convex parts, tracks that are no circle: what they must show."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.core.errors import GeometryError, ParameterError
from csas_shadow_ros.core.geometry import TWO_PI, unit_to_sonar
from csas_shadow_ros.simulation import Bump, Faults, Patch, Seabed, get_profile, simulate
from csas_shadow_ros.simulation.bodies import above_seabed, bar, brick, ellipsoid, frustum, ring, settled
from csas_shadow_ros.simulation.seabed import SeabedModel

TINY = get_profile("tiny")
QUICK = get_profile("tiny", rows=256, cols=256, block_deg=2.0, pose_step_deg=2.0)


def digest(run):
    return hashlib.sha256(run.image.pixels.tobytes() + run.track.positions_m.tobytes()).hexdigest()


def view(run, aspect_deg, width_deg=20.0):
    """Return the power seen from one arc, softly cut off in aspect, on the image's own lattice."""
    grid = run.image.grid
    kx = TWO_PI * np.fft.fftfreq(grid.cols, grid.spacing_m)[None, :]
    ky = -TWO_PI * np.fft.fftfreq(grid.rows, grid.spacing_m)[:, None]
    off = np.mod(np.degrees(np.arctan2(ky, kx)) - aspect_deg + 180.0, 360.0) - 180.0
    window = np.cos(np.minimum(np.abs(off) / (width_deg / 2.0), 1.0) * math.pi / 2.0)
    return np.abs(np.fft.ifft2(np.fft.fft2(run.image.pixels) * window)) ** 2


def coordinates(grid):
    x = grid.x_min_m + np.arange(grid.cols) * grid.spacing_m
    y = grid.y_max_m - np.arange(grid.rows) * grid.spacing_m
    return np.meshgrid(x, y)


def db(power_a, power_b):
    return 10.0 * math.log10(float(np.mean(power_a)) / float(np.mean(power_b)))


# ---- seabeds


def test_a_plain_seabed_leaves_every_bit_as_it_was():
    assert digest(simulate(QUICK, "box", seed=1)) == digest(
        simulate(QUICK, "box", seed=1, bed=Seabed(seed=7))
    )


def test_a_patch_and_a_step_have_their_levels_from_every_side():
    bed = Seabed(patches=(Patch((-0.3, 0.0), (0.25, 0.25), 0.0, -9.0),), step_db=6.0, step_m=0.2)
    run = simulate(TINY, "empty", seed=2, bed=bed, faults=Faults(contrast_db=40.0))
    x, y = coordinates(run.image.grid)
    plain = (np.abs(y) > 0.5) & (x < 0.1)
    for aspect in (0.0, 90.0, 215.0):
        power = view(run, aspect)
        assert db(power[np.hypot(x + 0.3, y) < 0.18], power[plain]) == pytest.approx(-9.0, abs=1.0)
        assert db(power[x > 0.3], power[plain]) == pytest.approx(6.0, abs=0.8)


def test_a_pit_is_dark_towards_the_sonar_and_bright_beyond():
    bed = Seabed(bumps=(Bump((0.0, 0.0), 0.4, -0.15),))  # slopes to 30°, the sonar at 22°
    run = simulate(TINY, "empty", seed=3, bed=bed, faults=Faults(contrast_db=30.0))
    x, y = coordinates(run.image.grid)
    flat = np.hypot(x, y) > 0.7
    for aspect in (0.0, 120.0):
        power = view(run, aspect)
        towards = unit_to_sonar(math.radians(aspect))
        along = x * towards[0] + y * towards[1]
        middle = np.hypot(x, y) < 0.28
        assert db(power[middle & (along > 0.12)], power[flat]) < -6.0
        assert db(power[middle & (along < -0.1)], power[flat]) > 1.5


def test_a_shadow_on_higher_ground_is_shorter():
    """The shadow of a box ends where the ray over its top meets the ground, not the plane z = 0."""
    sonar = np.array([30.0, 0.0, 12.0])
    rise, tan = 0.1, 12.0 / 30.0
    model = SeabedModel(Seabed(bumps=(Bump((0.0, 0.0), 500.0, rise),)), TINY.grid)  # level for the image
    lit = np.zeros((128, 128), np.float32)
    lit[:, :40] = 1.0  # beyond x0, on the plane, the shadow of the box ends
    seen = model.seen(sonar, lit, (slice(0, 128), slice(0, 128)), 128, 128)
    cell = TINY.cols * TINY.spacing_m / 128
    first = int(np.argmax(seen[64] < 0.5))
    assert (first - 40) * cell == pytest.approx(rise * (tan + 1.0 / tan), abs=1.5 * cell)


def test_ripples_show_where_they_lie_across_the_line_of_sight():
    bed = Seabed(ripple_m=0.01, ripple_length_m=0.32, ripple_deg=0.0)
    run = simulate(TINY, "empty", seed=4, bed=bed, faults=Faults(contrast_db=30.0))
    x, _ = coordinates(run.image.grid)

    def modulation(aspect):
        power = view(run, aspect)
        return abs(np.mean(power * np.exp(1j * TWO_PI * x / 0.32))) / np.mean(power)

    assert modulation(0.0) > 3.0 * modulation(90.0)


@pytest.mark.parametrize("field", [{"step_db": 90.0}, {"texture_m": 0.0}, {"ripple_m": -1.0}])
def test_seabeds_out_of_bounds_are_refused(field):
    with pytest.raises(ParameterError):
        Seabed(**field)


# ---- tracks


def test_a_circle_off_centre_an_ellipse_and_a_spiral_are_where_they_are_said_to_be():
    off = simulate(QUICK, "empty", faults=Faults(track_offset_m=(3.0, -2.0))).track.positions_m
    np.testing.assert_allclose(np.hypot(off[:, 0] - 3.0, off[:, 1] + 2.0), QUICK.radius_m, rtol=1e-9)
    ellipse = simulate(QUICK, "empty", faults=Faults(ellipse=0.1, ellipse_deg=90.0)).track.positions_m
    axes = np.abs(ellipse).max(axis=0)[:2] / QUICK.radius_m
    np.testing.assert_allclose(axes, (0.9, 1.1), rtol=1e-3)
    spiral = simulate(QUICK, "empty", faults=Faults(spiral_m=2.0), clockwise=True).track.positions_m
    ranges = np.hypot(spiral[:, 0], spiral[:, 1])
    assert np.all(np.diff(ranges) > 0)
    assert ranges[-1] - ranges[0] == pytest.approx(2.0, rel=0.02)


def test_over_a_slope_the_sonar_is_lower_than_the_track_says_where_the_seabed_rises():
    run = simulate(QUICK, "box", seed=1, faults=Faults(tilt_deg=2.0, tilt_towards_deg=90.0))
    assert np.allclose(run.track.positions_m[:, 2], QUICK.height_m)
    lower = run.track.positions_m[:, 2] - run.truth.sonar_m[:, 2]
    np.testing.assert_allclose(lower, run.track.positions_m[:, 1] * math.tan(math.radians(2.0)), atol=1e-9)


def test_a_radial_shift_and_a_drift_move_the_picture_and_not_the_track():
    plain = simulate(QUICK, "empty", seed=5)
    for faults, by in (
        (Faults(radial_shift_m=0.02), {0.0: (0.02, 0.0), 90.0: (0.0, 0.02), 180.0: (-0.02, 0.0)}),
        # At aspect θ a share θ/360 of the circle is passed: from minus to plus half of it. What it grows by
        # with aspect, 0.08 m / 2π along the line of sight, turns into a shift across it.
        (
            Faults(drift_m=(0.0, 0.08)),
            {90.0: (-0.08 / TWO_PI, -0.02), 270.0: (-0.08 / TWO_PI, 0.02), 180.0: (0.0, 0.0)},
        ),
    ):
        moved = simulate(QUICK, "empty", seed=5, faults=faults)
        assert np.array_equal(moved.track.positions_m, plain.track.positions_m)
        for aspect, expected in by.items():
            a, b = (np.fft.fft2(view(run, aspect)) for run in (plain, moved))
            peak = np.fft.ifft2(b * np.conj(a)).real
            row, col = np.unravel_index(int(np.argmax(peak)), peak.shape)
            shift = np.array([col, -row], float)
            shift[shift > 128] -= 256
            shift[shift < -128] += 256
            np.testing.assert_allclose(shift * QUICK.spacing_m, expected, atol=1.1 * QUICK.spacing_m)


# ---- bodies


def test_what_is_cut_off_at_the_seabed_is_closed_and_has_the_volume_that_it_must():
    half = above_seabed([ellipsoid((1.0, 0.8, 0.6))])
    assert half[0].is_watertight
    assert half[0].volume == pytest.approx(math.pi / 6.0 * 0.48 / 2.0, rel=0.02)
    assert half[0].bounds[0, 2] == 0.0
    low = brick((1.0, 0.5, 0.4), (0.0, 0.0, -0.3))
    (left,) = above_seabed([low])
    assert left.volume == pytest.approx(0.05)
    with pytest.raises(GeometryError, match="buried whole"):
        above_seabed([brick((1.0, 1.0, 1.0), (0.0, 0.0, -2.0))])


@pytest.mark.parametrize(
    "parts",
    [
        [frustum(1.0, 0.4, 0.5)],
        [frustum(1.0, 0.0, 0.5)],
        [bar((0, 0, 0.1), (1, 0, 0.1), 0.2)],
        ring(1.0, 0.3),
    ],
)
def test_a_settled_body_stands_closed_on_the_seabed_and_sinks_by_its_share(parts):
    for tilt, buried in ((0.0, 0.0), (0.3, 0.4)):
        left = settled(parts, tilt_rad=tilt, about_rad=1.0, buried=buried)
        assert all(part.is_watertight and part.volume > 0 for part in left)
        corners = np.concatenate([part.vertices for part in left])
        assert corners[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        turned = trimesh.transformations.rotation_matrix(tilt, (math.cos(1.0), math.sin(1.0), 0.0))
        whole = np.concatenate([part.vertices for part in parts]) @ turned[2, :3]
        assert corners[:, 2].max() == pytest.approx((1.0 - buried) * np.ptp(whole), rel=1e-6)


def test_a_ring_has_the_volume_of_its_tube_and_a_hole():
    parts = ring(1.0, 0.2)
    volume = sum(part.volume for part in parts)
    assert volume == pytest.approx(2.0 * math.pi**2 * 0.4 * 0.1**2, rel=0.05)
    assert not any(part.contains([[0.0, 0.0, 0.0]])[0] for part in parts)
