"""What a simulated run must show, measured with literal processing: full-size FFT, mask, FFT back."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.fft
import scipy.stats
import trimesh

from csas_shadow_ros.core.errors import GeometryError, ParameterError
from csas_shadow_ros.core.geometry import TWO_PI, unit_to_sonar
from csas_shadow_ros.simulation import Faults, Scene, get_profile, make_scene, simulate
from csas_shadow_ros.simulation.run import Wedges, _BlockMaker, _white
from csas_shadow_ros.simulation.scene import SceneModel, project_shadow
from csas_shadow_ros.simulation.targets import box, empty_mesh

TINY = get_profile("tiny")


def spectrum_of(run, *, true_sign=True):
    """Return S and each bin's |K| and aspect, with rows running north to south."""
    grid = run.image.grid
    sign = run.truth.acoustics.spectrum_sign if true_sign else run.image.acoustics.spectrum_sign
    kx = TWO_PI * np.fft.fftfreq(grid.cols, grid.spacing_m)[None, :]
    ky = -TWO_PI * np.fft.fftfreq(grid.rows, grid.spacing_m)[:, None]
    aspect = np.mod(np.arctan2(sign * ky, sign * kx), TWO_PI)
    return scipy.fft.fft2(run.image.pixels, norm="forward"), np.hypot(kx, ky), aspect


def sub_aperture(run, aspect_deg, width_deg, *, true_sign=True):
    """Return the picture made of the wavenumbers of one arc, softly cut off so that nothing bright leaks."""
    spectrum, k, aspect = spectrum_of(run, true_sign=true_sign)
    low, _, high = run.truth.profile.band_rad_m
    across = np.abs(np.mod(aspect - math.radians(aspect_deg) + math.pi, TWO_PI) - math.pi)
    across /= math.radians(width_deg) / 2.0
    along = np.abs(k - (low + high) / 2.0) / ((high - low) / 2.0)
    window = np.cos(np.minimum(across, 1.0) * math.pi / 2) * np.cos(np.minimum(along, 1.0) * math.pi / 2)
    return scipy.fft.ifft2(spectrum * window**2, norm="forward")


def shadow_mask(mesh, sonar_m, grid):
    """Return True where a convex mesh hides the seabed: the convex hull of its projected corners."""
    points = project_shadow(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(sonar_m))
    uv = points @ grid.ground_to_pixel[:2, :2].T + grid.ground_to_pixel[:2, 2]
    out = np.zeros(grid.shape, dtype=np.uint8)
    cv2.fillConvexPoly(out, cv2.convexHull(np.rint(uv).astype(np.int32)), 1)
    return out > 0


def sonar_at(profile, aspect_deg):
    a = math.radians(aspect_deg)
    return np.array([profile.radius_m * math.cos(a), profile.radius_m * math.sin(a), profile.height_m])


def floating_cube(x, y, z, side=0.02):
    cube = trimesh.creation.box(extents=(side, side, side))
    cube.apply_translation([x, y, z])
    return Scene("cube", cube, empty_mesh(), (), (side, side, side), (x, y), 0.0)


@pytest.fixture(scope="module")
def empty_run():
    return simulate(TINY, "empty", seed=5)


BOX = box(0.5, 0.4, 0.25)


@pytest.fixture(scope="module")
def box_run():
    return simulate(TINY, BOX, seed=3, position_m=(0.15, -0.1), heading_deg=20)


def test_energy_lies_in_the_annulus_of_the_band_and_nowhere_else(box_run):
    spectrum, k, _ = spectrum_of(box_run)
    low, _, high = TINY.band_rad_m
    power = np.abs(spectrum) ** 2
    inside = (k >= low) & (k < high)
    assert power[~inside].sum() < 1e-9 * power.sum()
    assert np.count_nonzero(power[inside] > 0) == np.count_nonzero(inside)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_raised_scatterer_is_imaged_at_its_layover_position_towards_the_sonar(sign):
    x, y, z = 0.3, -0.2, 0.5
    run = simulate(TINY, floating_cube(x, y, z), seed=1, echo_db=75.0, spectrum_sign=sign)
    for aspect_deg in (0.5, 77.5, 200.5, 291.5):
        picture = np.abs(sub_aperture(run, aspect_deg, 40.0))
        row, col = np.unravel_index(picture.argmax(), picture.shape)
        seen = np.array([run.image.grid.x_of_columns()[col], run.image.grid.y_of_rows()[row]])
        expected = np.array([x, y]) + z * math.tan(TINY.grazing_rad) * unit_to_sonar(math.radians(aspect_deg))
        # The visible faces lie up to half a cube nearer and higher than its middle.
        assert np.linalg.norm(seen - expected) < 0.02, aspect_deg


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aspect_deg", [20.0, 110.0, 200.0, 290.0])
def test_a_box_darkens_the_seabed_behind_it_by_the_stated_contrast(box_run, sign, aspect_deg):
    run = (
        box_run
        if sign == 1
        else simulate(TINY, BOX, seed=3, position_m=(0.15, -0.1), heading_deg=20, spectrum_sign=-1)
    )
    grid, width = run.image.grid, 16.0
    power = np.abs(sub_aperture(run, aspect_deg, width)) ** 2
    always = np.ones(grid.shape, dtype=bool)
    ever = np.zeros(grid.shape, dtype=bool)
    for a in np.arange(aspect_deg - width / 2, aspect_deg + width / 2 + 0.1, 1.0):
        mask = shadow_mask(run.truth.target, sonar_at(TINY, a), grid)
        always &= mask
        ever |= mask
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (25, 25))
    dark = cv2.erode(always.astype(np.uint8), kernel, borderValue=0) > 0
    # The target itself echoes; look behind it.
    x, y = np.meshgrid(grid.x_of_columns(), grid.y_of_rows())
    towards = unit_to_sonar(math.radians(aspect_deg))
    along = (x - 0.15) * towards[0] + (y + 0.1) * towards[1]
    dark &= along < -0.38
    lit = (np.hypot(x - 0.15, y + 0.1) > 0.5) & ~(cv2.dilate(ever.astype(np.uint8), kernel) > 0)
    assert dark.sum() > 800
    contrast_db = 10 * math.log10(power[lit].mean() / power[dark].mean())
    assert contrast_db == pytest.approx(15.0, abs=1.5)
    # The same region mirrored to the sonar's side is seabed.
    behind_to_front = np.column_stack(
        [x[dark] - 2 * along[dark] * towards[0], y[dark] - 2 * along[dark] * towards[1]]
    )
    uv = np.rint(behind_to_front @ grid.ground_to_pixel[:2, :2].T + grid.ground_to_pixel[:2, 2]).astype(int)
    front = power[uv[:, 1], uv[:, 0]].mean()
    assert abs(10 * math.log10(front / power[lit].mean())) < 1.5


def test_an_image_with_the_wrong_sign_in_its_metadata_shows_shadows_towards_the_claimed_sonar():
    run = simulate(TINY, BOX, seed=3, faults=Faults(wrong_sign=True))
    assert run.image.acoustics.spectrum_sign == -1
    assert run.truth.acoustics.spectrum_sign == 1
    grid = run.image.grid
    power = np.abs(sub_aperture(run, 90.0, 16.0, true_sign=False)) ** 2
    column = power[:, grid.cols // 2 - 20 : grid.cols // 2 + 20].mean(axis=1)
    y = grid.y_of_rows()
    behind, before = column[(y < -0.4) & (y > -0.6)].mean(), column[(y > 0.4) & (y < 0.6)].mean()
    assert before < 0.2 * behind  # claimed aspect 90° is really 270°


def test_an_l_shape_is_not_mirrored():
    run = simulate(TINY, "l_shape", seed=2, heading_deg=30, echo_db=-40.0)
    mirrored = make_scene("l_shape").target
    mirrored.vertices = mirrored.vertices * [1, -1, 1]
    mirrored.apply_transform(trimesh.transformations.rotation_matrix(math.radians(30), [0, 0, 1]))
    for aspect_deg in (10.0, 100.0, 190.0, 280.0):
        power = np.abs(sub_aperture(run, aspect_deg, 20.0)) ** 2
        masks = []
        for mesh in (run.truth.target, mirrored):
            limbs = (mesh.vertices[:8], mesh.vertices[8:])  # each convex
            parts = [
                shadow_mask(trimesh.PointCloud(v), sonar_at(TINY, aspect_deg), run.image.grid) for v in limbs
            ]
            masks.append(parts[0] | parts[1])
        true, wrong = masks
        level = np.median(power[~true & ~wrong])
        assert np.count_nonzero(true & ~wrong) > 1000
        assert np.median(power[true & ~wrong]) < 0.4 * level, aspect_deg
        assert np.median(power[wrong & ~true]) > 0.7 * level, aspect_deg


def test_an_empty_seabed_is_rayleigh_with_mode_one(empty_run):
    amplitude = np.abs(empty_run.image.pixels)
    assert np.sqrt(np.mean(amplitude.astype(np.float64) ** 2) / 2) == pytest.approx(1.0, abs=0.01)
    # Pixels a few resolution cells apart are independent.
    assert scipy.stats.kstest(amplitude[::7, ::7].ravel(), scipy.stats.rayleigh.cdf).pvalue > 0.01


def test_the_same_seed_gives_the_same_bits_on_one_thread_or_two(box_run):
    again = simulate(TINY, BOX, seed=3, position_m=(0.15, -0.1), heading_deg=20, workers=1)
    assert np.array_equal(again.image.pixels, box_run.image.pixels)
    assert np.array_equal(again.track.positions_m, box_run.track.positions_m)


def test_another_seed_gives_another_seabed(empty_run):
    other = simulate(TINY, "empty", seed=6).image.pixels
    correlation = abs(np.vdot(other, empty_run.image.pixels)) / np.linalg.norm(other) ** 2
    assert correlation < 0.02


def test_the_seabed_does_not_depend_on_how_the_circle_is_cut_into_blocks(empty_run):
    other = simulate(get_profile(TINY, block_deg=2.0, pose_step_deg=0.5), "empty", seed=5)
    # Noise is drawn in the order of the blocks: it alone differs.
    difference = np.linalg.norm(other.image.pixels - empty_run.image.pixels)
    assert difference < 1.1 * math.sqrt(2 * 10**-1.5) * np.linalg.norm(empty_run.image.pixels)
    quiet = Faults(contrast_db=80.0)
    a = simulate(TINY, "empty", seed=5, faults=quiet).image.pixels
    b = simulate(get_profile(TINY, block_deg=2.0), "empty", seed=5, faults=quiet).image.pixels
    assert np.linalg.norm(a - b) < 2e-4 * np.linalg.norm(a)


@pytest.mark.parametrize("shape", [(512, 512), (300, 431)])
def test_wedges_partition_the_annulus(shape):
    profile = get_profile(TINY, rows=shape[0], cols=shape[1])
    wedges = Wedges.of(profile)
    count = np.zeros(shape, dtype=int)
    np.add.at(count, (wedges.q, wedges.p), 1)
    k = np.hypot(
        TWO_PI * np.fft.fftfreq(shape[1], profile.spacing_m)[None, :],
        TWO_PI * np.fft.fftfreq(shape[0], profile.spacing_m)[:, None],
    )
    low, _, high = profile.band_rad_m
    assert np.array_equal(count, ((k >= low) & (k < high)).astype(int))
    assert len(wedges) == 360
    for block in range(360):
        aspect = np.degrees(wedges.aspect_rad[wedges.starts[block] : wedges.starts[block + 1]])
        assert np.all((aspect > block - 1e-4) & (aspect < block + 1 + 1e-4))


def test_missing_arcs_have_no_energy_and_no_poses():
    run = simulate(TINY, "empty", seed=1, faults=Faults(missing_arcs_deg=((30.0, 50.0), (350.0, 365.0))))
    spectrum, k, aspect = spectrum_of(run)
    low, _, high = TINY.band_rad_m
    ring = (k >= low) & (k < high)
    degrees = np.degrees(aspect)
    lost = ((degrees > 30.01) & (degrees < 49.99)) | (degrees > 350.01) | (degrees < 4.99)
    kept = ((degrees > 5.01) & (degrees < 29.99)) | ((degrees > 50.01) & (degrees < 349.99))
    typical = np.median(np.abs(spectrum[ring & kept]))
    assert np.abs(spectrum[ring & lost]).max() < 1e-4 * typical
    assert np.count_nonzero(np.abs(spectrum[ring & kept]) < 1e-3 * typical) < 10
    gaps = sorted((math.degrees(g.start_rad), math.degrees(g.width_rad)) for g in run.track.gaps)
    assert np.allclose(gaps, [(30.0, 20.0), (350.0, 15.0)], atol=1e-6)


def _literal_block(maker, sonar_m, aspect_rad, q, p):
    """S of one block, full size: seabed × mask pixel by pixel, and each echo's phase written out."""
    profile, grid = maker.profile, maker.profile.grid
    lit, window = maker.model.lit_fraction(sonar_m, grid, *grid.shape)
    picture = scipy.fft.ifft2(maker.seabed)
    picture[window] *= lit
    out = scipy.fft.fft2(picture)[q, p].astype(np.complex128)
    points, amplitude = maker.model._visible(sonar_m)
    kx = TWO_PI * p / (profile.cols * profile.spacing_m)
    ky = -TWO_PI * q / (profile.rows * profile.spacing_m)
    along = kx * math.cos(aspect_rad) + ky * math.sin(aspect_rad)  # K cos(θ - θ_b), K to 4e-5
    tan = sonar_m[2] / math.hypot(*sonar_m[:2])
    echo = np.zeros(len(q), dtype=np.complex128)
    for (x, y, z), a in zip(points, amplitude, strict=True):
        echo += a * np.exp(-1j * (kx * (x - grid.x_min_m) + ky * (y - grid.y_max_m) + along * tan * z))
    return out, echo / math.sqrt(profile.rows * profile.cols * profile.spacing_m**2)


@pytest.mark.parametrize("block", [0, 40, 135, 311])
def test_a_block_made_in_its_small_box_equals_the_literal_full_size_sums(block):
    profile = get_profile(TINY, rows=384, edge_m=0.012)
    wedges = Wedges.of(profile)
    model = SceneModel(
        make_scene("tyre", (0.1, 0.05)),
        seed=0,
        echo_db=10,
        scatterer_spacing_m=0.04,
        cable_db=0,
        cell_m=(1, 1),
    )
    seabed = _white(np.random.default_rng(0), (profile.rows, profile.cols))
    maker = _BlockMaker(profile, wedges, model, seabed, 0.0, ())
    aspect = math.radians(block + 0.5)
    sonar = sonar_at(profile, block + 0.5)
    part = slice(wedges.starts[block], wedges.starts[block + 1])
    q, p = wedges.q[part], wedges.p[part]
    seabed, echo = _literal_block(maker, sonar, aspect, q, p)
    made = maker._echoes(q, p, sonar, aspect)
    assert np.linalg.norm(made - echo) < 1e-3 * np.linalg.norm(echo)
    made = maker._seabed_in_shadow(q, p, sonar)
    unshadowed = maker.seabed[q, p]
    # The shadow's edges are drawn 12 mm fine instead of 5 mm.
    assert np.linalg.norm(made - seabed) < 0.1 * np.linalg.norm(seabed - unshadowed)


def test_an_off_centre_rectangular_image_shows_the_target_where_it_stands():
    profile = get_profile(TINY, rows=320, cols=512, centre_m=(0.5, -0.3))
    run = simulate(profile, floating_cube(0.9, -0.1, 0.01), seed=1, echo_db=75.0)
    picture = np.abs(run.image.pixels)
    row, col = np.unravel_index(picture.argmax(), picture.shape)
    assert run.image.grid.x_of_columns()[col] == pytest.approx(0.9, abs=0.02)
    assert run.image.grid.y_of_rows()[row] == pytest.approx(-0.1, abs=0.02)


def test_echoes_that_fall_outside_the_image_do_not_wrap_round():
    quiet = simulate(TINY, "empty", seed=1).image.pixels
    run = simulate(TINY, floating_cube(1.35, 0.0, 0.05), seed=1, echo_db=75.0)
    assert np.abs(run.image.pixels[:, :64] - quiet[:, :64]).max() < 0.5 * np.abs(quiet).max()


def test_what_stands_behind_a_wall_neither_echoes_nor_darkens_what_is_dark_already():
    wall = trimesh.creation.box(bounds=[[0.3, -0.3, 0.0], [0.35, 0.3, 0.4]])
    cube = floating_cube(0.1, 0.0, 0.02).target
    both = trimesh.util.concatenate([wall, cube])
    scenes = [Scene("s", mesh, empty_mesh(), (), (0, 0, 0), (0, 0), 0.0) for mesh in (wall, both, cube)]
    models = [
        SceneModel(s, seed=0, echo_db=0, scatterer_spacing_m=0.01, cable_db=0, cell_m=(1, 1)) for s in scenes
    ]
    front, back = sonar_at(TINY, 0.0), sonar_at(TINY, 180.0)

    def echoes_near_cube(model, sonar):
        points, _ = model._visible(sonar)
        return np.count_nonzero(np.abs(points[:, 0] - 0.1) < 0.02)

    assert echoes_near_cube(models[1], front) == 0
    assert echoes_near_cube(models[1], back) > 2
    assert echoes_near_cube(models[2], front) > 2
    (lit, window), (lit_both, window_both) = (m.lit_fraction(front, TINY.grid, 512, 512) for m in models[:2])
    assert window == window_both
    assert np.array_equal(lit, lit_both)


def test_a_shadow_covers_its_exact_area_whatever_the_cells():
    corner, size = 0.3, (0.41, 0.33)
    plate = trimesh.creation.box(bounds=[[-corner, -0.2, 0.0], [size[0] - corner, size[1] - 0.2, 1e-4]])
    scene = Scene("s", plate, empty_mesh(), (), (0, 0, 0), (0, 0), 0.0)
    model = SceneModel(scene, seed=0, echo_db=0, scatterer_spacing_m=0.01, cable_db=0, cell_m=(1, 1))
    for cells in (512, 384, 131):
        lit, _ = model.lit_fraction(sonar_at(TINY, 40.0), TINY.grid, cells, cells)
        cell = 512 * TINY.spacing_m / cells
        assert (1.0 - lit).sum() * cell**2 == pytest.approx(size[0] * size[1], rel=0.01)


def test_a_cable_glints_only_where_it_lies_across_the_line_of_sight():
    x = np.linspace(-0.5, 0.5, 1001)
    cable = np.column_stack([x, 0.02 * (1.0 - 4.0 * x**2), np.full_like(x, 0.005)])  # bends by ±4.6°
    run = simulate(TINY, Scene("cable", empty_mesh(), empty_mesh(), (cable,), (0, 0, 0), (0, 0), 0.0), seed=1)
    grid = run.image.grid
    level = {}
    for aspect_deg in (0.0, 45.0, 90.0, 130.0):
        power = np.abs(sub_aperture(run, aspect_deg, 20.0)) ** 2
        u, v = (cable[200:801:50, :2] @ grid.ground_to_pixel[:2, :2].T + grid.ground_to_pixel[:2, 2]).T
        on = power[np.rint(v).astype(int), np.rint(u).astype(int)].mean()
        level[aspect_deg] = 10 * math.log10(on / power.mean())
    assert level[90.0] > 8.0
    assert max(level[a] for a in (0.0, 45.0, 130.0)) < 4.0


def test_simulating_needs_no_ros():
    code = (
        "import sys\n"
        "for name in ('rclpy', 'rosbags', 'sensor_msgs', 'nav_msgs'): sys.modules[name] = None\n"
        "from csas_shadow_ros.simulation import get_profile, simulate\n"
        "simulate(get_profile('tiny', rows=64, cols=64), 'empty')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, cwd=Path(__file__).parents[2])


def test_clockwise_runs_pass_the_same_aspects_the_other_way(empty_run):
    run = simulate(TINY, "empty", seed=5, clockwise=True, start_aspect_deg=90.0)
    assert np.array_equal(run.image.pixels, empty_run.image.pixels)
    assert np.all(np.diff(run.track.aspects_rad) < 0)
    assert run.track.aspects_rad[0] == pytest.approx(math.pi / 2)
    assert run.track.gaps == ()
    assert empty_run.track.gaps == ()


def test_the_track_passes_at_the_stated_speed_and_the_image_is_stamped_at_its_end(empty_run):
    track = empty_run.track
    assert len(track) == 720
    step = np.linalg.norm(np.diff(track.positions_m, axis=0), axis=1)
    assert np.allclose(step / (np.diff(track.stamps_ns) * 1e-9), 1.5, rtol=1e-4)
    assert empty_run.image.stamp_ns == track.stamps_ns[-1]


def test_a_wobbling_track_is_reported_as_it_was():
    profile = get_profile(TINY, rows=64, cols=64)
    run = simulate(profile, "empty", seed=4, faults=Faults(track_wobble_m=0.2))
    assert np.array_equal(run.track.positions_m, run.truth.sonar_m)
    height = run.track.positions_m[:, 2] - profile.height_m
    ground = np.hypot(*run.track.positions_m[:, :2].T) - profile.radius_m
    assert np.std(height) == pytest.approx(0.2, rel=0.05)
    assert np.std(ground) == pytest.approx(0.2, rel=0.05)
    assert np.abs(np.diff(height)).max() < 0.05  # smooth over half a degree


def test_shadows_follow_the_true_height_not_the_reported_one():
    def far_edge(run):
        grid = run.image.grid
        power = cv2.blur(np.abs(sub_aperture(run, 0.0, 16.0)) ** 2, (7, 61))
        line = power[grid.rows // 2]
        x = grid.x_of_columns()
        dark = (line < 0.35 * np.median(power)) & (x < -0.3)
        return -x[dark].min()

    low = simulate(get_profile(TINY, height_m=9.0), BOX, seed=1)
    told = simulate(get_profile(TINY, height_m=9.0), BOX, seed=1, faults=Faults(height_error=0.1))
    assert told.track.positions_m[:, 2] == pytest.approx(9.9)
    assert np.array_equal(told.image.pixels, low.image.pixels)
    assert far_edge(low) == pytest.approx(0.25 + 0.25 * 30 / 9, abs=0.08)


def test_phase_error_has_the_stated_rms_at_the_centre_frequency():
    clean = simulate(TINY, "empty", seed=1, faults=Faults(contrast_db=80))
    wrong = simulate(TINY, "empty", seed=1, faults=Faults(contrast_db=80, phase_error_rad=0.4))
    a, k, _ = spectrum_of(clean)
    b, _, _ = spectrum_of(wrong)
    low, centre, high = TINY.band_rad_m
    ring = (k >= low) & (k < high)
    phase = np.angle(b[ring] / a[ring]) * centre / k[ring]
    assert np.sqrt(np.mean(phase**2)) == pytest.approx(0.4, rel=0.02)


def test_a_quadratic_phase_error_reaches_its_value_at_the_edges_of_its_arcs():
    faults = Faults(contrast_db=80, quadratic_phase_rad=1.0, quadratic_arc_deg=12.0)
    a, k, aspect = spectrum_of(simulate(TINY, "empty", seed=1, faults=Faults(contrast_db=80)))
    b, _, _ = spectrum_of(simulate(TINY, "empty", seed=1, faults=faults))
    low, centre, high = TINY.band_rad_m
    ring = (k >= low) & (k < high)
    phase = np.angle(b[ring] / a[ring]) * centre / k[ring]
    within = np.mod(np.degrees(aspect[ring]), 12.0)
    assert np.abs(phase[np.abs(within - 6.0) < 0.3]).max() < 0.02
    assert np.median(phase[within < 0.3]) == pytest.approx(0.95, abs=0.05)
    assert np.median(phase[np.abs(within - 3.0) < 0.2]) == pytest.approx(0.25, abs=0.03)


def test_a_wrong_sound_speed_is_in_the_metadata_only(empty_run):
    run = simulate(TINY, "empty", seed=5, faults=Faults(sound_speed_error=0.02))
    assert run.image.acoustics.sound_speed_mps == pytest.approx(1530.0)
    assert run.truth.acoustics.sound_speed_mps == 1500.0
    assert np.array_equal(run.image.pixels, empty_run.image.pixels)


def test_a_seabed_slope_raises_the_level_from_west_to_east():
    run = simulate(TINY, "empty", seed=1, faults=Faults(seabed_slope_db=8.0, contrast_db=40))
    power = np.mean(np.abs(run.image.pixels) ** 2, axis=0)
    level = 10 * np.log10(power)
    slope = np.polyfit(np.arange(len(level)) / len(level), level, 1)[0]
    assert slope == pytest.approx(8.0, abs=0.7)


def test_noise_sets_the_shadow_level():
    noise = [simulate(TINY, "empty", seed=1, faults=Faults(contrast_db=c)).image.pixels for c in (10, 30)]
    quiet = simulate(TINY, "empty", seed=1, faults=Faults(contrast_db=100)).image.pixels
    for c, pixels in zip((10, 30), noise, strict=True):
        seabed = quiet * math.sqrt(1 - 10 ** (-c / 10))
        share = np.mean(np.abs(pixels - seabed) ** 2) / np.mean(np.abs(pixels) ** 2)
        assert 10 * math.log10(share) == pytest.approx(-c, abs=0.1)


def test_the_truth_is_written_and_read_back(box_run, tmp_path):
    stl, record = box_run.truth.save(tmp_path / "run")
    assert (stl.name, record.name) == ("run.truth.stl", "run.truth.json")
    mesh = trimesh.load(stl, force="mesh")
    assert np.allclose(mesh.bounds, box_run.truth.target.bounds, atol=1e-6)
    assert mesh.volume == pytest.approx(0.5 * 0.4 * 0.25, rel=1e-5)
    assert '"seed": 3' in record.read_text()


def test_a_simulated_bag_gives_the_run_back(tmp_path):
    bags = pytest.importorskip("csas_shadow_ros.bags")
    from csas_shadow_ros.simulation import simulate_bag

    made = simulate_bag(tmp_path / "bag", get_profile(TINY, rows=64, cols=96), "box", seed=1)
    read = bags.read_run(tmp_path / "bag")
    assert np.array_equal(read.image.pixels, made.image.pixels)
    assert read.image.acoustics == made.image.acoustics
    assert np.allclose(read.track.positions_m, made.track.positions_m, atol=1e-9)
    assert (tmp_path / "bag.truth.stl").exists()


def test_progress_counts_every_block():
    seen = []
    simulate(get_profile(TINY, rows=64, cols=64), "empty", progress=lambda i, n: seen.append((i, n)))
    assert seen == [(i, 360) for i in range(1, 361)]


def test_a_band_beyond_the_lattice_is_refused():
    with pytest.raises(ParameterError, match=r"'samdis'.*2688.*2513"):
        get_profile("samdis", height_m=18.0)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: simulate("huge", "box"), "profile is 'huge'; expected one of: tiny, small"),
        (lambda: simulate(TINY, "boat"), "target is 'boat'; expected one of frame"),
        (lambda: simulate(TINY, "empty", seed=-1), "seed is -1; expected"),
        (lambda: simulate(TINY, "empty", spectrum_sign=0), "spectrum_sign is 0; expected"),
        (lambda: get_profile("tiny", block_deg=0.7), "block_deg is 0.7 deg; expected a divisor"),
        (lambda: get_profile("tiny", depth_m=3), "unknown parameter 'depth_m'"),
        (lambda: Faults(contrast_db=-3), "contrast_db is -3 dB; expected"),
        (lambda: Faults(missing_arcs_deg=((50, 30),)), r"missing arc is \(50, 30\) deg; expected"),
        (lambda: Faults(missing_arcs_deg=(30,)), r"missing arc is 30; expected \(start, stop\)"),
        (lambda: simulate(TINY, floating_cube(0, 0, 0.1), heading_deg=3), "neither with a ready scene"),
        (lambda: simulate(TINY, "empty", faults=Faults(track_wobble_m=50)), "track_wobble_m is 50 m"),
    ],
)
def test_bad_arguments_are_refused_by_name_and_value(call, match):
    with pytest.raises(ParameterError, match=match):
        call()


def test_a_target_higher_than_the_sonar_is_refused():
    with pytest.raises(GeometryError, match="scene reaches z = 20 m; expected under the sonar at 12 m"):
        simulate(get_profile(TINY, rows=64, cols=64), box(1.0, 1.0, 20.0))
