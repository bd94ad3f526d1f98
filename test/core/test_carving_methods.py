"""One table tells the carving methods apart; an unknown name is never taken for one of them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.methods import METHODS, Method, method_named
from csas_shadow_ros.core.parameters import CarvingParameters
from csas_shadow_ros.core.shape.carving import Carver, part_around
from csas_shadow_ros.core.shape.threshold import (
    needed_threshold,
    object_threshold,
    occupied_voxels,
    thresholded,
)
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.nodes.runtime.params import ViewerNodeParameters

ROOT = Path(__file__).resolve().parents[2]
VOLUME = Volume.around((0.0, 0.0), (0.6, 0.6, 0.6), 0.1)
LIKELIHOOD = np.full(VOLUME.shape, 0.9, np.float32)
LIKELIHOOD[0:3, 1:5, 1:5] = 0.0
VIEWS = np.full(VOLUME.shape, 9, np.uint16)

ASKED = {
    "threshold": lambda name: object_threshold(LIKELIHOOD, name),
    "voxels": lambda name: occupied_voxels(LIKELIHOOD, 0.1, name),
    "needed": lambda name: needed_threshold(LIKELIHOOD, name),
    "grid": lambda name: VoxelGrid(VOLUME, LIKELIHOOD, VIEWS, 0.1, LIKELIHOOD < 0.1, name),
    "parameters": lambda name: CarvingParameters(method=name),
    "viewer": lambda name: ViewerNodeParameters(method=name),
}


@pytest.mark.parametrize("asked", ASKED)
def test_an_unknown_method_is_refused_with_the_choices(asked):
    with pytest.raises(CsasError, match=r"method is 'solf'; expected one of: consensus, hard, soft"):
        ASKED[asked]("solf")


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize("name", METHODS)
def test_every_method_of_the_table_is_known_everywhere(asked, name):
    ASKED[asked](name)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_carves_with_the_views_that_its_entry_names(name):
    method, p = method_named(name), CarvingParameters(method=name)
    assert p.takes_masks == (method.takes == "shadow_mask")
    assert p.other().method == method.other
    assert thresholded(VOLUME, LIKELIHOOD, VIEWS, p).occupied.sum() == 3 * 4 * 4


def test_the_names_that_type_checkers_know_are_those_of_the_table():
    assert get_args(Method) == tuple(METHODS)


def test_the_page_on_the_method_has_the_table():
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)`(?: \(default\))? \| ([^|]*) \| ([^|]*) \|$", text, re.MULTILINE)
    assert rows == [(m.name, m.adds, m.object_where) for m in METHODS.values()]


def test_the_operators_page_has_a_name_for_every_method():
    source = (ROOT / "viewer_web" / "src" / "app.js").read_text(encoding="utf-8")
    (labels,) = re.findall(r"^const METHODS = \{(.*)\};$", source, re.MULTILINE)
    assert set(re.findall(r"(\w+):", labels)) == set(METHODS)


def test_no_other_file_of_the_method_tells_methods_apart_by_name():
    told = re.compile(r"""method\s*(==|!=|in)\s*\(?["']""")
    for path in sorted((ROOT / "csas_shadow_ros").rglob("*.py")):
        assert not told.search(path.read_text(encoding="utf-8")), path


def test_a_part_of_a_volume_is_carved_as_in_the_whole():
    """The views that know the best known voxel count, wherever that lies: a part alone held no object."""
    volume = Volume.around((0.0, 0.0), (1.2, 1.2, 0.6), 0.1)
    carver = Carver(volume, CarvingParameters())
    carver.stamps = set(range(60))
    counts, likelihood = np.full(volume.shape, 28, np.uint16), np.ones(volume.shape, np.float32)
    counts[:, 0, 0] = 60  # a corner that all views know
    counts[2, 4:8, 4:8], likelihood[2, 4:8, 4:8] = 40, 0.0
    carver._sums._count[:], carver._sums._total[:] = counts, np.rint(counts * likelihood * 4096)
    whole = carver.first_look()
    assert whole.occupied.sum() == 3 * 16, "what fewer than half of them know is open below a body"
    box, part = part_around(whole.occupied, volume, 1)
    near = carver._in_part(box, part)
    assert counts[box].max() == 40
    assert (near.first_look().occupied == whole.occupied[box]).all()
    assert (near.leaner().first_look().occupied == whole.occupied[box]).all()
