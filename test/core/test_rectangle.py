"""Tests of plans of a simple shape: with errors of the sides, any convex plan is too free."""

import math
from dataclasses import replace

import numpy as np
import pytest
from core_data import box_support, drawn_sides_of, make_info

from csas_shadow_ros.core.shape import measurement
from csas_shadow_ros.core.shape.measurement import PlanFit, measure_object
from csas_shadow_ros.core.shape.mesh import mesh_from_grid
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid

INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 4))
#: Sides err by so much (1 sigma, cross-range cells), as those of the population do.
NOISE_CELLS = 0.5
CELL_M = INFOS[0].resolution_m[1]


def oval_support(length, width, heading=0.0):
    return lambda phi: (
        0.5 * np.hypot(length * np.cos(np.asarray(phi) - heading), width * np.sin(np.asarray(phi) - heading))
    )


def corner_support(size):
    """A right-angled triangle, whose equal sides are `size` long, about the middle of its square."""
    corners = np.array([(0.0, 0.0), (size, 0.0), (0.0, size)]) - size / 2.0

    def support(phi):
        return np.max([x * np.cos(phi) + y * np.sin(phi) for x, y in corners], axis=0)

    return support


def noisy(support, seed):
    rng = np.random.default_rng(seed)
    return [
        replace(one, support_m=tuple(s + NOISE_CELLS * CELL_M * rng.standard_normal() for s in one.support_m))
        for one in drawn_sides_of(INFOS, support)
    ]


def grid_of_plan(support):
    volume = Volume.around((0.0, 0.0), (1.2, 1.2, 0.4), 0.02)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    phi = np.radians(np.arange(0.0, 360.0, 1.0))
    inside = np.all(
        [x * math.cos(p) + y * math.sin(p) <= h for p, h in zip(phi, support(phi), strict=True)], 0
    )
    occupied = inside & (z < 0.2)
    views = np.full(occupied.shape, len(INFOS), np.uint16)
    return VoxelGrid(volume, np.where(occupied, 0.0, 1.0).astype(np.float32), views, 0.1, occupied)


def errors_cells(support, sizes, seeds=range(6)):
    """Return how much too long and too wide a plan is, mean over draws of errors of its sides."""
    grid = grid_of_plan(support)
    mesh = mesh_from_grid(grid)
    found = [measure_object(grid, mesh, noisy(support, seed)) for seed in seeds]
    told = np.array([(one.length_m, one.width_m) for one in found])
    return (told.mean(axis=0) - sizes) / CELL_M


def test_a_box_is_as_long_and_wide_as_it_is_though_its_sides_err(monkeypatch):
    support = box_support(0.6, 0.4, 0.5)
    rectangle = errors_cells(support, (0.6, 0.4))
    monkeypatch.setattr(measurement, "shape_of_plan", lambda *_: None)
    any_plan = errors_cells(support, (0.6, 0.4))
    assert np.abs(rectangle).max() < 0.2
    assert any_plan.min() > 0.3


def test_a_round_plan_is_not_as_narrow_as_its_sides_err(monkeypatch):
    """The smallest rectangle lies where the errors make it narrowest."""
    support = oval_support(0.5, 0.5)
    circle = errors_cells(support, (0.5, 0.5))
    monkeypatch.setattr(measurement, "shape_of_plan", lambda *_: None)
    any_plan = errors_cells(support, (0.5, 0.5))
    assert np.abs(circle).max() < 0.2
    assert any_plan[1] < -0.25


@pytest.mark.parametrize(
    ("support", "shape"),
    [
        (box_support(0.6, 0.4, 0.5), "rectangle"),
        (box_support(0.4, 0.4, 1.0), "rectangle"),
        (box_support(0.8, 0.3, 0.2), "rectangle"),
        (oval_support(0.6, 0.4, 0.5), "ellipse"),
        (oval_support(0.6, 0.6), "circle"),
        # Of either an edge's error leaves too little to tell a circle from a square.
        (oval_support(2.0 * CELL_M, 2.0 * CELL_M), None),
        (box_support(2.0 * CELL_M, 2.0 * CELL_M), None),
        (corner_support(0.5), None),
    ],
)
def test_a_plan_has_a_shape_only_where_sides_tell_it(monkeypatch, support, shape):
    assert told_shapes(monkeypatch, support) == [shape] * 4


def test_a_circle_of_six_cells_is_no_rectangle(monkeypatch):
    assert "rectangle" not in told_shapes(monkeypatch, oval_support(0.4, 0.4))


def told_shapes(monkeypatch, support):
    """Return the shape that each of four draws of errors tells."""
    told = []
    ask = measurement.shape_of_plan

    def watched(*given):
        told.append(ask(*given))
        return told[-1]

    monkeypatch.setattr(measurement, "shape_of_plan", watched)
    for seed in range(4):
        fit = PlanFit(noisy(support, seed), grid_of_plan(support))
        fit.plan(measurement._rectangle(fit.solve(), fit.centre))
    return told
