"""One simulated run, and bags of it, that tests of several parts share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import settings

from csas_shadow_ros.bags import write_run
from csas_shadow_ros.simulation import SimulatedRun, simulate

# A busy machine is no fault: no example is timed.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@dataclass(frozen=True)
class BagOfRun:
    """A bag with its truth beside it, and the run that it was made of."""

    path: Path
    run: SimulatedRun


def write_bag(path: Path, run: SimulatedRun, **options) -> BagOfRun:
    write_run(path, run.image, run.track, **options)
    run.truth.save(path)
    return BagOfRun(path, run)


@pytest.fixture(scope="session")
def tiny_box_bag(tmp_path_factory) -> BagOfRun:
    """A bag of a box of 0.8 m × 0.4 m × 0.4 m, turned by 20°, on the smallest profile."""
    run = simulate("tiny", "box", seed=5, heading_deg=20.0)
    return write_bag(tmp_path_factory.mktemp("bags") / "tiny_box", run)


@pytest.fixture(scope="session")
def tiny_empty_bag(tmp_path_factory) -> BagOfRun:
    """A bag of an empty seabed."""
    run = simulate("tiny", "empty", seed=6)
    return write_bag(tmp_path_factory.mktemp("bags") / "tiny_empty", run)
