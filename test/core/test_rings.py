"""Ground that a body encloses: its own lit top, or a floor on which its walls' shadow falls."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from core_data import make_info

from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.imaging.mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from csas_shadow_ros.core.shape.explained import cast_shadow
from csas_shadow_ros.core.shape.rings import enclosed, filled_rings
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid

INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 30))
CELL_M = 0.06
VOLUME = Volume.around((0.0, 0.0), (1.2, 1.0, 0.4), 0.04)


def walls(gap_m=0.0):
    """Walls 8 cm thick and 20 cm high round 0.8 x 0.6 m, one of them with a gap."""
    x, y = np.meshgrid(np.abs(VOLUME.x_m), np.abs(VOLUME.y_m))
    plan = (x < 0.48) & (y < 0.38) & ~((x < 0.40) & (y < 0.30))
    plan[:, VOLUME.x_m > 0.0] &= y[:, VOLUME.x_m > 0.0] >= gap_m / 2.0
    occupied = np.zeros(VOLUME.shape, bool)
    occupied[VOLUME.z_m < 0.2] = plan
    return VoxelGrid(
        VOLUME, (~occupied).astype(np.float32), np.full(VOLUME.shape, 12, np.uint16), 0.03, occupied
    )


def views_of(body, lit=None):
    """Masks of a body's own shadow, lit as coded where it falls on the ground within the walls."""
    inside = replace(body, occupied=enclosed(body.occupied))
    floor = inside.occupied[:1]
    out = []
    for info in INFOS:
        blank = View(info, np.full(info.camera.shape, MASK_OUTSIDE, np.uint8))
        pixels = np.where(cast_shadow(blank, VOLUME, body.occupied), MASK_SHADOW, MASK_OUTSIDE)
        if lit is not None:
            ground = Volume((*VOLUME.origin_m[:2], 0.0), VOLUME.voxel_size_m, floor.shape)
            pixels[cast_shadow(blank, ground, floor)] = lit
        out.append(View(info, pixels.astype(np.uint8)))
    return out


@pytest.mark.parametrize("lit", [MASK_OUTSIDE, MASK_COVERED])
def test_ground_that_is_lit_where_the_walls_cast_their_shadow_is_a_top(lit):
    body = walls()
    filled = filled_rings(body, views_of(body, lit), CELL_M)
    x, y = np.meshgrid(np.abs(VOLUME.x_m), np.abs(VOLUME.y_m))
    assert np.array_equal(filled[VOLUME.z_m < 0.2], np.broadcast_to((x < 0.48) & (y < 0.38), (5, *x.shape)))
    assert not filled[VOLUME.z_m > 0.2].any()


@pytest.mark.parametrize("lit", [None, MASK_UNKNOWN])
def test_ground_in_the_walls_shadow_or_under_an_echo_stays_as_it_is(lit):
    body = walls()
    assert filled_rings(body, views_of(body, lit), CELL_M) is body.occupied


@pytest.mark.parametrize(("gap_m", "closed"), [(0.08, True), (0.24, False)])
def test_gaps_of_two_cells_in_the_walls_are_closed_and_no_wider_ones(gap_m, closed):
    body = walls(gap_m)
    free = enclosed(body.occupied, CELL_M / VOLUME.voxel_size_m)
    assert free.any() == closed
    whole = enclosed(walls().occupied)
    assert not closed or free[whole].all()


def test_a_ring_that_stands_on_legs_encloses_no_ground():
    body = walls()
    lifted = np.roll(body.occupied, 4, axis=0)
    lifted[:4, ::23, ::29] = True
    assert not enclosed(lifted).any()
