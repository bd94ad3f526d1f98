"""A run that is still going on: sectors in any order; at the end the views and the grid of the whole run."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from core_data import band_limited_image, circle_track

from csas_shadow_ros.core.errors import CsasError, SpectrumSignError
from csas_shadow_ros.core.geometry import Track
from csas_shadow_ros.core.geometry.arcs import Arc, Arcs
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    PipelineParameters,
    SubApertureParameters,
    TargetParameters,
)
from csas_shadow_ros.core.pipeline import run as run_whole
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.core.sectors.streaming import SectorSum, Stream, StreamedRun
from csas_shadow_ros.simulation import simulate
from csas_shadow_ros.simulation.sectors import sectors_of_run

AUTO = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=10.0), carving=CarvingParameters(voxel_size_m=0.05)
)
GIVEN = replace(AUTO, target=TargetParameters(target="given", position_m=(0.2, -0.1), size_m=(1.5, 1.5, 0.7)))


@pytest.fixture(scope="session")
def simulated():
    return simulate("tiny", "box", seed=1, position_m=(0.2, -0.1), start_aspect_deg=17.0)


@pytest.fixture(scope="session")
def sectors(simulated):
    return [sector for sector, _ in sectors_of_run(simulated.image, simulated.track, 15.0)]


def sum_of(sectors):
    total = SectorSum()
    for sector in sectors:
        total.add(sector)
    return total


def whole(sectors, track, parameters):
    """Process the same sectors as one run that is over."""
    total = sum_of(sectors)
    return run_whole(total.image(), track, parameters, spectrum=total.spectrum)


def streamed(sectors, track, parameters, **options):
    run = StreamedRun(parameters, **options)
    run.take_track(track)
    for sector in sectors:
        run.add(sector)
    run.finish()
    return run


def assert_same_grid(run, result):
    grid = run.grid()
    assert grid is not None
    assert result.grid is not None
    assert run.stream.target == result.target
    np.testing.assert_array_equal(grid.likelihood, result.grid.likelihood)
    np.testing.assert_array_equal(grid.views, result.grid.views)
    np.testing.assert_array_equal(grid.occupied, result.grid.occupied)


def in_order(sectors):
    return sectors


def shuffled_with_repeats(sectors):
    mixed = [*sectors, *sectors[::3]]
    random.Random(5).shuffle(mixed)
    return mixed


def with_a_hole(sectors):
    return [*sectors[:4], *sectors[6:]]


@pytest.mark.parametrize(
    ("order", "parameters"),
    [
        pytest.param(in_order, AUTO, id="in_order-auto", marks=pytest.mark.long),
        pytest.param(shuffled_with_repeats, AUTO, id="shuffled-auto"),
        pytest.param(with_a_hole, AUTO, id="with_a_hole-auto"),
        pytest.param(in_order, GIVEN, id="in_order-given", marks=pytest.mark.long),
        pytest.param(shuffled_with_repeats, GIVEN, id="shuffled-given"),
        pytest.param(with_a_hole, GIVEN, id="with_a_hole-given", marks=pytest.mark.long),
    ],
)
def test_the_grid_is_that_of_the_whole_run_bit_for_bit(simulated, sectors, order, parameters):
    come = order(sectors)
    run = streamed(come, simulated.track, parameters)
    assert_same_grid(run, whole(come, simulated.track, parameters))
    assert run.stream.final


def test_sectors_of_a_simulated_run_give_the_grid_of_its_image(simulated, sectors):
    result = run_whole(simulated.image, simulated.track, AUTO)
    assert_same_grid(streamed(sectors, simulated.track, AUTO), result)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_order_of_sectors_changes_no_bit_of_their_sum_which_is_the_image(sign, clockwise):
    image = band_limited_image(sign)
    track = circle_track(clockwise=clockwise, start_deg=33.0)
    made = [sector for sector, _ in sectors_of_run(image, track, 12.0)]
    forwards, backwards = sum_of(made), sum_of(made[::-1])
    np.testing.assert_array_equal(forwards.spectrum.values, backwards.spectrum.values)
    assert forwards.arcs.whole
    error = np.abs(forwards.image().pixels - image.pixels).max()
    assert error < 1e-5 * np.abs(image.pixels).max()


def test_a_view_made_on_the_way_is_the_view_of_the_whole_run(simulated, sectors):
    run = StreamedRun(GIVEN)
    run.take_track(simulated.track)
    made = [view for sector in sectors[:8] for view in run.add(sector)]
    assert made
    end = {
        view.sub_aperture.info.stamp_ns: view.sub_aperture.pixels
        for view in streamed_views(sectors[::-1], simulated.track)
    }
    for view in made:
        np.testing.assert_array_equal(view.sub_aperture.pixels, end[view.sub_aperture.info.stamp_ns])


def streamed_views(sectors, track):
    run = StreamedRun(GIVEN)
    run.take_track(track)
    return [view for sector in sectors for view in run.add(sector)]


def test_a_view_is_made_as_soon_as_the_sectors_cover_its_aperture_and_no_sooner(simulated, sectors):
    stream = Stream(GIVEN.sub_aperture, GIVEN.target)
    stream.take_track(simulated.track)
    half, width = math.radians(6.0), math.radians(15.0)
    start, done = simulated.track.aspects_rad[0], set()
    for count, sector in enumerate(sectors[:-1], start=1):
        stream.add(sector)
        done |= set(stream.update())
        ahead = np.mod(np.radians(np.arange(36) * 10.0) - start, 2 * math.pi)
        inside = (ahead - half >= 2e-4) & (ahead + half <= count * width - 2e-4)
        assert len(done) == int(inside.sum())
    stream.add(sectors[-1])
    done |= set(stream.update())
    assert len(done) == 36
    assert stream.revision == 0, "nothing was made twice"


def test_the_search_of_the_whole_circle_can_wait_for_the_last_sectors_views(simulated, sectors):
    stream = Stream(GIVEN.sub_aperture, GIVEN.target)
    stream.take_track(simulated.track)
    for sector in sectors[:-1]:
        stream.add(sector)
    before = set(stream.update())
    stream.add(sectors[-1])
    assert stream.ended
    last = set(stream.update(decide=False))
    assert not stream.final
    assert len(before | last) == 36
    assert stream.update(decide=False) == []
    assert stream.update() == []
    assert stream.final
    assert stream.revision == 0


def test_what_only_the_end_makes_due_waits_for_it(simulated, sectors):
    stream = Stream(GIVEN.sub_aperture, GIVEN.target)
    stream.take_track(simulated.track)
    for sector in with_a_hole(sectors):
        stream.add(sector)
    whole_ones = set(stream.update())
    stream.finish()
    assert stream.update(decide=False) == []
    assert len(whole_ones | set(stream.update())) == 36


def test_a_target_is_looked_for_on_the_way_and_again_when_the_circle_is_closed(simulated, sectors):
    run = StreamedRun(AUTO, first_search_deg=120.0)
    run.take_track(simulated.track)
    views = [len(run.add(sector)) for sector in sectors]
    assert views[:7] == [0] * 7
    assert views[7] > 0, "eight sectors of 15° are 120°"
    assert views[-1] == 36, "the target of the whole circle is another: all views are due again"
    assert run.stream.revision == 1
    assert run.stream.final


def test_a_late_sector_that_changes_views_makes_them_due_again(simulated, sectors):
    run = StreamedRun(GIVEN)
    run.take_track(simulated.track)
    for sector in sectors[:-1]:
        run.add(sector)
    run.finish()
    assert run.stream.final
    assert [str(arc) for arc in run.stream.missing()] == ["2.0° to 17.0°"]
    run.add(sectors[-1])
    assert run.stream.counts["late"] == 1
    assert run.stream.revision == 1
    assert run.stream.missing() == []
    assert_same_grid(run, whole(sectors, simulated.track, GIVEN))


def test_repeated_and_disordered_sectors_are_counted(simulated, sectors):
    stream = Stream(GIVEN.sub_aperture, GIVEN.target)
    for index in (0, 2, 1, 1, 3):
        stream.add(sectors[index])
    assert dict(stream.counts) == {"sectors": 4, "out_of_order": 1, "repeated": 1}


def test_a_track_that_grows_with_the_run_gives_the_same_grid_in_the_end(simulated, sectors):
    track = simulated.track
    run = StreamedRun(GIVEN)
    for count, sector in enumerate(sectors, start=1):
        poses = len(track) * count // len(sectors)
        run.take_track(Track(track.stamps_ns[:poses], track.positions_m[:poses]))
        run.add(sector)
    assert run.grid() is not None
    assert_same_grid(run, whole(sectors, track, GIVEN))


def test_a_wrong_spectrum_sign_is_refused_when_the_circle_is_closed(simulated, sectors):
    wrong = [replace(s, acoustics=replace(s.acoustics, spectrum_sign=-1)) for s in sectors]
    with pytest.raises(SpectrumSignError, match="expected"):
        streamed(wrong, simulated.track, AUTO)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"aperture_rad": 0.0}, "expected an arc of more than 0°"),
        ({"pixels": None}, r"1 of \d+ pixels not finite, the first at row 3, column 4"),
    ],
)
def test_a_sector_that_cannot_be_used_is_named_and_the_sum_goes_on(sectors, change, message):
    total = sum_of(sectors[:2])
    before = total.spectrum.values.copy()
    if "pixels" in change:
        pixels = sectors[2].pixels.copy()
        pixels[3, 4] = np.nan
        change = {"pixels": pixels}
    with pytest.raises(CsasError, match=message):
        total.add(replace(sectors[2], **change))
    np.testing.assert_array_equal(total.spectrum.values, before)
    total.add(sectors[2])
    np.testing.assert_array_equal(total.spectrum.values, sum_of(sectors[:3]).spectrum.values)


def test_energy_beyond_its_arc_is_summed_too(sectors):
    image = band_limited_image()
    thirds = [Sector(image.pixels / 3, image.grid, image.acoustics, 1 + i, float(i), 0.1) for i in range(3)]
    total = sum_of(thirds)
    assert total.margin_rad == math.pi, "every view waits for all of them"
    assert np.abs(total.image().pixels - image.pixels).max() < 1e-5 * np.abs(image.pixels).max()


@pytest.mark.parametrize("seed", range(20))
def test_arcs_know_what_they_cover_touch_and_miss(seed):
    rng = random.Random(seed)
    arcs, marks = Arcs(), np.zeros(360, bool)
    for _ in range(rng.randrange(1, 8)):
        start, width = rng.randrange(-360, 720), rng.randrange(1, 120)
        arcs.add(Arc(math.radians(start), math.radians(width)))
        marks[(start + np.arange(width)) % 360] = True
    assert math.degrees(arcs.covered_rad) == pytest.approx(marks.sum())
    assert arcs.whole == marks.all()
    middles = np.radians(np.arange(360) + 0.5)
    np.testing.assert_array_equal(arcs.contains(middles), marks)
    for _ in range(50):
        start, width = rng.randrange(360), rng.randrange(1, 359)
        inside = marks[(start + np.arange(width)) % 360].all()
        assert arcs.cover(Arc(math.radians(start), math.radians(width))) == inside
    missing = np.zeros(360, bool)
    for arc in arcs.missing():
        first = round(math.degrees(arc.start_rad))
        missing[(first + np.arange(round(math.degrees(arc.width_rad)))) % 360] = True
    np.testing.assert_array_equal(missing, ~marks)
