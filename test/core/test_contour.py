"""The height that both ends of a shadow tell together, whatever the plan."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from core_data import HEIGHT_M, RADIUS_M, make_info

from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.core.shape.contour import Contour, contour_height, contour_of
from csas_shadow_ros.simulation import simulate
from csas_shadow_ros.simulation.profiles import Profile

GRAZING = math.atan2(HEIGHT_M, RADIUS_M)
INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 10))
#: By a band ten times as high: cells ten times as fine.
FINE = tuple(
    replace(info, acoustics=replace(info.acoustics, centre_frequency_hz=6e5, bandwidth_hz=2.4e5))
    for info in INFOS
)


def contour_through(info, across, down, height):
    """The shadow behind points (m) on the contour: its ends have the slant range of echo and of seabed."""
    origin = math.hypot(*info.camera.sonar_m[:2])
    sonar_z = info.camera.sonar_m[2]
    ground = origin + np.asarray(down)
    begin = np.sqrt(ground**2 + (sonar_z - height) ** 2 - sonar_z**2)
    end = ground * sonar_z / (sonar_z - height)
    return Contour(*(tuple(map(float, a)) for a in (across, begin - origin, end - origin)))


def flat_top(info, height=0.2, half=0.3):
    across = np.arange(-half, half, 0.012)
    return contour_through(info, across, np.full(len(across), half), np.full(len(across), height))


def sphere(info, radius=0.5):
    across = np.arange(-0.96 * radius, 0.96 * radius, 0.012)
    inner = np.sqrt(radius**2 - across**2)
    psi = math.atan2(HEIGHT_M, RADIUS_M)
    return contour_through(info, across, inner * math.sin(psi), radius + inner * math.cos(psi))


def measured_sphere(info, radius=0.5):
    """Its sides drop by twice as much as those of an exact one, as the near end is told too far behind."""
    exact = sphere(info, radius)
    across, down, height = exact.points(info)
    return contour_through(info, across, down, height - (height.max() - height))


@pytest.mark.parametrize(
    ("shape", "top_m", "round_top", "off_m"),
    [(flat_top, 0.2, False, 0.01), (measured_sphere, 1.0, True, 0.01), (sphere, 1.0, None, 0.03)],
)
def test_both_ends_of_the_shadow_give_the_height_of_an_edge_and_of_a_round_top(
    shape, top_m, round_top, off_m
):
    told = contour_height([(info, shape(info)) for info in FINE], (0.0, 0.0), 2.0)
    assert told is not None
    assert told.round_top is round_top
    assert told.height_m == pytest.approx(top_m, abs=off_m)
    assert abs(told.height_m - top_m) < 1.96 * told.sigma_m


def tower(info, foot_m):
    """A flat top of half a metre, and beside it the lower contour of a wider foot."""
    across = np.arange(-0.6, 0.6, 0.012)
    on_top = np.abs(across) < 0.25
    return contour_through(info, across, np.where(on_top, 0.45, 0.5), np.where(on_top, 0.6, foot_m))


def test_a_top_that_stands_on_a_wider_foot_is_not_read_as_round():
    """Its contour drops to its sides much more than a sphere's; it came out too high by the sphere's cap."""
    assert contour_height([(info, tower(info, 0.2)) for info in FINE], (0.0, 0.0), 2.0) is None
    flat = contour_height([(info, tower(info, 0.6)) for info in FINE], (0.0, 0.0), 2.0)
    assert flat is not None
    assert flat.round_top is False
    assert flat.height_m == pytest.approx(0.6, abs=0.01)


def test_a_top_that_cells_are_too_coarse_to_tell_round_from_flat_may_be_either():
    told = contour_height([(info, sphere(info, 0.35)) for info in INFOS], (0.0, 0.0), 2.0)
    assert told is not None
    assert told.round_top is None
    assert abs(told.height_m - 0.7) < 1.96 * told.sigma_m


def test_views_that_disagree_tell_no_height():
    told = [(info, flat_top(info, 0.2 if n % 5 else 0.35)) for n, info in enumerate(INFOS)]
    assert contour_height(told, (0.0, 0.0), 2.0) is None
    assert contour_height([], (0.0, 0.0), 2.0) is None


def ring(info, rim=0.45, height=0.3):
    """The shadow of a far rim, seen through the hole: it begins where that of the near rim ends."""
    across = np.arange(-rim / 2.0, rim / 2.0, 0.012)
    origin = math.hypot(*info.camera.sonar_m[:2])
    sonar_z = info.camera.sonar_m[2]
    far = np.sqrt(rim**2 - across**2)
    end = (origin + far) * sonar_z / (sonar_z - height) - origin
    return Contour(*(tuple(map(float, a)) for a in (across, 0.1 - far, end)))


def dark_top(info, half=0.3, height=0.2):
    """A flat top as dark as its shadow, which seems to begin at the near side."""
    told = flat_top(info, height, half)
    return replace(told, begin_m=tuple(begin - 2.0 * half for begin in told.begin_m))


@pytest.mark.parametrize("shape", [ring, dark_top])
def test_a_contour_before_the_middle_all_round_the_circle_tells_no_height(shape):
    """A tyre of 0.38 m came out 0.50 ± 0.02 m high, a drum of 0.15 m with a dark top 0.20 ± 0.01 m."""
    assert contour_height([(info, shape(info)) for info in INFOS], (0.0, 0.0), 2.0) is None


def test_a_plan_that_lies_off_the_middle_it_is_told_by_still_tells_its_height():
    told = contour_height([(info, flat_top(info)) for info in INFOS], (0.05, -0.05), 2.0)
    assert told is not None
    assert told.height_m == pytest.approx(0.2, abs=0.01)


def test_no_height_is_told_above_what_the_shadows_leave():
    told = contour_height([(info, flat_top(info)) for info in INFOS], (0.0, 0.0), 0.19)
    assert told is not None
    assert told.height_m == 0.19


def test_a_contour_far_above_what_the_shadows_leave_is_not_the_target_s():
    """Of a bucket that stood wider at its top, contours told 1.10 m; its shadows left 1.03 m."""
    assert contour_height([(info, flat_top(info)) for info in INFOS], (0.0, 0.0), 0.12) is None


def point(info, height=0.4, half=0.3):
    across = np.arange(-half, half, 0.012)
    up = 0.002 + height * (1.0 - np.abs(across) / half)
    return contour_through(info, across, np.zeros(len(across)), up)


def test_a_top_that_few_columns_reach_has_no_height_of_its_own():
    """Views lose the tip of a cone, and all lose as much: they agree on too little."""
    assert contour_height([(info, point(info)) for info in FINE], (0.0, 0.0), 2.0) is None


def test_a_contour_ends_where_its_column_s_last_shadow_does():
    info = INFOS[0]
    down = info.down_range_of_rows()
    shadow = np.zeros(info.camera.shape, np.bool_)
    shadow[100:104, 90:130] = True  # another body's, well before
    shadow[120:160, 90:130] = True
    shadow[140, 100] = False  # a speckle
    found = contour_of(shadow, info)
    assert found is not None
    assert len(found.across_m) == 40
    row_m = info.camera.spacing_m[0]
    # The segmented shadow begins most of a cell behind the end of the top's echo.
    assert np.ptp(found.begin_m) == 0.0
    late = (down[120] - row_m / 2.0 - found.begin_m[0]) / info.resolution_m[0]
    assert 0.5 <= late <= 1.4
    assert found.end_m == pytest.approx([down[159] + row_m / 2.0] * 40)


def test_a_shadow_that_leaves_the_image_or_is_too_narrow_has_no_contour():
    info = INFOS[0]
    shadow = np.zeros(info.camera.shape, np.bool_)
    shadow[200:, 90:130] = True
    assert contour_of(shadow, info) is None
    shadow[:] = False
    shadow[120:160, 90:92] = True
    assert contour_of(shadow, info) is None


def test_a_low_wide_box_seen_steeply_is_not_as_high_as_its_cap():
    """Carving leaves a cap of 0.3 m on it, as shadows alone do; it came out 0.45 m high."""
    profile = Profile(
        "steep", rows=640, cols=640, spacing_m=0.006, radius_m=30.0, height_m=20.0, centre_frequency_hz=60e3,
        bandwidth_hz=20e3, edge_m=0.02,
    )  # fmt: skip
    box = trimesh.creation.box((0.9, 0.84, 0.17))
    box.apply_translation((0.0, 0.0, 0.085))
    made = simulate(profile, box, seed=48, heading_deg=20.0, echo_db=12.0, workers=2)
    parameters = PipelineParameters(
        SubApertureParameters(step_deg=6.0), carving=CarvingParameters(voxel_size_m=0.03)
    )
    measured = run(made.image, made.track, parameters).dimensions
    assert measured is not None
    assert measured.hull_top_m > 0.3
    assert measured.height_m == pytest.approx(0.17, abs=0.02)
    low, high = measured.intervals["height_m"]
    assert low < 0.17 < high
