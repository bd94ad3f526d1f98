"""A simulated run cut into the sectors that it would have come as."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.fft

from csas_shadow_ros.bags import read_run
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.sectors.streaming import SectorSum
from csas_shadow_ros.nodes.playing import BagViews
from csas_shadow_ros.simulation import Faults, simulate, simulate_bag
from csas_shadow_ros.simulation.sectors import sectors_of_run


@pytest.mark.parametrize("clockwise", [False, True])
def test_sectors_come_in_the_order_in_which_the_sonar_passes_each_after_its_arc(clockwise):
    run = simulate("tiny", "empty", clockwise=clockwise, start_aspect_deg=50.0)
    made = list(sectors_of_run(run.image, run.track, 30.0))
    turns = -1 if clockwise else 1
    aspects = [math.degrees(sector.aspect_rad) for sector, _ in made]
    assert np.allclose(aspects, [(50.0 + turns * (15.0 + 30.0 * i)) % 360.0 for i in range(12)])
    stamps, times = [s.stamp_ns for s, _ in made], [when for _, when in made]
    assert stamps == sorted(stamps)
    assert times == sorted(times)
    for sector, when in made:
        passed = when - sector.stamp_ns
        whole = int(run.track.stamps_ns[-1] - run.track.stamps_ns[0])
        assert passed == pytest.approx(whole / 24, rel=0.05), "half an arc after its middle"


def test_a_sector_is_at_baseband():
    run = simulate("tiny", "empty")
    sector, _ = next(sectors_of_run(run.image, run.track, 10.0))
    power = np.abs(scipy.fft.fft2(sector.pixels)) ** 2
    rows, cols = (np.fft.fftfreq(n) * 2 * math.pi / run.image.grid.spacing_m for n in power.shape)
    outside = np.hypot(rows[:, None], cols[None, :]) > 200.0
    assert power[outside].sum() < 1e-6 * power.sum()
    assert math.hypot(*sector.carrier_rad_m) > 400.0


def test_a_bag_of_sectors_says_when_each_was_made_and_leaves_out_what_the_sonar_missed(tmp_path: Path):
    path = tmp_path / "run"
    faults = Faults(missing_arcs_deg=((60.0, 120.0),))
    run = simulate_bag(path, "tiny", "empty", sectors_deg=30.0, faults=faults)
    bag = read_run(path)
    assert bag.image is None
    assert bag.counts == {"sector": 10}
    views = BagViews(bag._reader, "sector")
    assert all(made > stamp for stamp, made in views.times.items())
    assert bag.sector_sum().arcs.covered_rad == pytest.approx(math.radians(300.0))
    error = np.abs(bag.coherent_image().pixels - run.image.pixels).max()
    assert error < 1e-5 * np.abs(run.image.pixels).max()


def test_a_bag_of_sectors_on_own_lattices_is_smaller_than_the_images_and_sums_to_it(tmp_path: Path):
    args = ["simulate", str(tmp_path / "own"), "--profile", "tiny", "--target", "empty", "-q"]
    assert main([*args, "--sectors", "15", "--sector-lattice", "own"]) == 0
    run = simulate("tiny", "empty", seed=0)
    bag = read_run(tmp_path / "own")
    assert sum(sector.pixels.nbytes for sector in bag.sectors()) < run.image.pixels.nbytes
    known = SectorSum(scene=run.image.grid)
    for sector in bag.sectors():
        known.add(sector)
    error = np.abs(known.image().pixels - run.image.pixels).max()
    assert error < 1e-5 * np.abs(run.image.pixels).max()


def test_a_width_that_does_not_divide_the_circle_is_refused():
    run = simulate("tiny", "empty")
    with pytest.raises(ParameterError, match="sector width is 7°; expected a divisor of 360°"):
        next(sectors_of_run(run.image, run.track, 7.0))
