"""Scenes drawn at random: the same every time, closed and on the seabed, and scored rightly."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.core.shape.mesh import Dimensions, measure
from csas_shadow_ros.core.shape.volume import VoxelGrid

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def population():
    """Return the benchmark's modules: they import one another from their own folder."""
    names = ("population_scenes", "population_scores", "population_page", "population")
    sys.path.insert(0, str(BENCHMARKS))
    try:
        modules = {name: importlib.import_module(name) for name in names}
        losses, edges = (importlib.import_module(f"population_{name}") for name in ("losses", "edges"))
    finally:
        sys.path.remove(str(BENCHMARKS))
    public = {k: v for m in modules.values() for k, v in vars(m).items() if not k.startswith("_")}
    return SimpleNamespace(**public, pages=modules["population_page"], losses=losses, edges=edges)


@pytest.fixture(scope="module")
def drawn(population):
    """Return the first scenes of each half."""
    return {half: [population.draw(half, index) for index in range(60)] for half in population.HALVES}


# ---- what is drawn


def test_a_scene_is_the_same_every_time_and_unlike_the_others(population, drawn):
    for half, specs in drawn.items():
        assert specs[:10] == [population.draw(half, index) for index in range(10)]
        assert len({spec.seed for spec in specs}) == len(specs)
    first, again = (population.draw("development", 1).meshes() for _ in range(2))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.vertices, b.vertices)
        assert np.array_equal(a.faces, b.faces)


def test_the_halves_share_no_family_and_no_shape(population, drawn):
    for one, two in itertools.combinations(population.HALVES, 2):
        families, others = population.FAMILIES[one], population.FAMILIES[two]
        assert not set(families) & set(others)
        assert not {f.make for f in families.values()} & {f.make for f in others.values()}
    for half, specs in drawn.items():
        assert {body.family for spec in specs for body in spec.bodies} == set(population.FAMILIES[half])


def test_three_scenes_of_five_have_objects_and_everything_that_may_be_added_is(population, drawn):
    for specs in drawn.values():
        assert sum(bool(spec.bodies) for spec in specs) == 36
    every = [spec for specs in drawn.values() for spec in specs]
    assert {c for spec in every for c in spec.complications} == set(population.COMPLICATIONS)
    assert set(population.COMPLICATION_TEXT) == set(population.COMPLICATIONS)


def test_what_is_drawn_is_within_what_the_page_states(population, drawn):
    for specs in drawn.values():
        for spec in specs:
            assert 4.0 <= spec.contrast_db <= 18.0
            assert 6.0 <= spec.grazing_deg <= 35.0
            assert spec.radius_m >= 20.0
            assert spec.echo_db == -100.0 or 0.0 <= spec.echo_db <= 20.0
            assert spec.pixels <= population.MOST_PIXELS
            low, high, _ = (spec.profile().band_rad_m[i] for i in (0, 2, 1))
            assert 0 < low < high < math.pi / spec.spacing_m
            for body in spec.bodies:
                assert 0.05 <= body.size_m <= 4.0


def test_every_body_is_closed_and_above_the_seabed_and_they_do_not_touch(drawn):
    for half, specs in drawn.items():
        for index, spec in enumerate(specs):
            meshes = spec.meshes()
            for mesh in meshes:
                assert mesh.is_watertight, (half, index)
                assert mesh.volume > 0.0, (half, index)
                assert abs(mesh.bounds[0, 2]) < 1e-9, (half, index)
            for i, a in enumerate(meshes):
                for b in meshes[:i]:
                    gap = np.linalg.norm(a.bounds[:, :2].mean(axis=0) - b.bounds[:, :2].mean(axis=0))
                    sides = [0.5 * np.ptp(m.bounds[:, :2], axis=0).min() for m in (a, b)]
                    assert gap > sum(sides), (half, index)


def test_every_family_of_both_halves_is_made_of_closed_parts_tilted_and_sunk(population):
    for families in population.FAMILIES.values():
        for name in families:
            for seed in range(2):
                mesh = population.Body(name, seed, 1.3, 20.0, 12.0, 40.0, 0.3).mesh()
                assert mesh.is_watertight, name
                assert abs(mesh.bounds[0, 2]) < 1e-9, name
                upright = population.Body(name, seed, 1.3).mesh()
                turns = np.linspace(0, math.pi, 181)
                plan = np.asarray(upright.vertices)[:, :2]
                longest = max(np.ptp(plan @ [math.cos(t), math.sin(t)]) for t in turns)
                assert max(longest, np.ptp(upright.bounds[:, 2])) >= 1.29, name


def test_every_main_body_is_wide_enough_to_be_seen_and_scored(population, drawn):
    for half, specs in drawn.items():
        for spec in (spec for spec in specs if spec.bodies and "cropped" not in spec.complications):
            body = population.TrueBody(spec.meshes()[0], SONAR, spec.voxel_m)
            assert body.sizes()["width_m"] >= 1.6 * spec.cell_m, (half, spec.index, spec.family)
            assert population.voxelise_truth(body.mesh, body.own_volume(spec.voxel_m)).sum() >= 8, spec.name


def test_shadows_are_in_the_image_unless_it_is_cropped(population, drawn):
    for spec in drawn["development"]:
        if not spec.bodies or "cropped" in spec.complications:
            continue
        half = 0.5 * spec.pixels * spec.spacing_m
        for mesh in spec.meshes():
            reach = np.hypot(*np.asarray(mesh.vertices)[:, :2].T).max()
            shadow = population.shadow_length_m(mesh.bounds[1, 2], spec.radius_m, spec.height_m)
            assert reach + shadow <= half * 1.02


# ---- scores


def result_of(*grids):
    """A result that holds grids as its objects, measured exactly as given."""
    objects = [
        SimpleNamespace(grid=grid, dimensions=Dimensions(length, width, height, 1.0, heading, (0.0, 0.0)))
        for grid, (length, width, height, heading) in grids
    ]
    return SimpleNamespace(objects=objects)


def grid_of(volume, occupied):
    blank = np.zeros(volume.shape, np.float32)
    return VoxelGrid(volume, blank, blank.astype(np.uint16), 0.1, occupied)


def measured(mesh):
    d = measure(mesh)
    return d.length_m, d.width_m, d.height_m, d.heading_rad


SONAR = np.array([[60 * math.cos(a), 60 * math.sin(a), 20.0] for a in np.radians(np.arange(0, 360, 3))])


@pytest.fixture
def spec(population):
    plain = next(s for s in (population.draw("development", i) for i in range(100)) if len(s.bodies) == 2)
    bodies = (
        population.Body("box", 1, 0.8, 30.0, 0.0, 0.0, 0.2, (0.1, 0.0)),
        population.Body("cone", 2, 0.6, 0.0, 0.0, 0.0, 0.0, (1.3, 0.4)),
    )
    return dataclasses.replace(plain, bodies=bodies, clutter=(), voxel_m=0.02)


def truths(population, spec):
    return [population.TrueBody(mesh, SONAR, spec.voxel_m) for mesh in spec.meshes()]


def test_the_truth_scored_against_itself_is_one_and_its_sizes_are_right(population, spec):
    found = []
    for truth in truths(population, spec):
        volume = truth.own_volume(spec.voxel_m)
        found.append((grid_of(volume, truth.on(volume)[1]), measured(truth.mesh)))
    scores, phantoms = population.score(spec, SONAR, result_of(*found))
    assert [s.family for s in scores] == ["box", "cone"]
    assert not phantoms
    for score in scores:
        assert (score.found, score.merged, score.iou_truth) == (True, False, 1.0)
        assert score.iou_hull == pytest.approx(score.hull_vs_truth, abs=0.02)
        assert all(score.within(name, 1e-6) for name in population.SIZES)


def test_the_hull_scored_against_itself_is_one(population, spec):
    found = []
    for truth in truths(population, spec):
        volume = truth.own_volume(spec.voxel_m)
        found.append((grid_of(volume, truth.on(volume)[0]), measured(truth.mesh)))
    scores, _ = population.score(spec, SONAR, result_of(*found))
    assert [s.iou_hull for s in scores] == [1.0, 1.0]


def test_a_body_that_is_not_found_an_object_that_is_none_and_one_that_is_two_are_told(population, spec):
    box, _ = truths(population, spec)
    volume = box.own_volume(spec.voxel_m)
    far = dataclasses.replace(volume, origin_m=(volume.origin_m[0] - 5.0, *volume.origin_m[1:]))
    own = grid_of(volume, box.on(volume)[1]), measured(box.mesh)
    phantom = grid_of(far, box.on(volume)[1]), measured(box.mesh)
    scores, phantoms = population.score(spec, SONAR, result_of(own, phantom))
    assert [s.found for s in scores] == [True, False]
    assert scores[1].iou_hull == 0.0
    assert len(phantoms) == 1
    wide = population.TrueBody(trimesh.util.concatenate(spec.meshes()), SONAR, spec.voxel_m)
    volume = wide.own_volume(spec.voxel_m)
    scores, _ = population.score(
        spec, SONAR, result_of((grid_of(volume, wide.on(volume)[1]), measured(wide.mesh)))
    )
    assert [s.merged for s in scores] == [True, True]
    assert all(s.iou_truth < 1.0 for s in scores)
    assert not scores[0].within("length_m", spec.voxel_m)


def test_true_sizes_are_of_what_is_above_the_seabed_along_the_bodys_own_axes(population):
    body = population.Body("box", 5, 1.0, 35.0, 0.0, 0.0, 0.6)
    whole = population.Body("box", 5, 1.0, 0.0).mesh().extents
    found = population.TrueBody(body.mesh(), SONAR, 0.02).sizes()
    assert found["length_m"] == pytest.approx(1.0, rel=1e-4)
    assert found["width_m"] == pytest.approx(min(whole[:2]), rel=1e-4)
    assert found["height_m"] == pytest.approx(0.4 * whole[2], rel=1e-4)


def test_of_a_round_plan_every_heading_is_right_and_of_a_long_one_it_is_not(population):
    keg = population.TrueBody(population.Body("keg", 1, 0.7).mesh(), SONAR, 0.02)
    pipe = population.TrueBody(population.Body("pipe", 1, 2.0).mesh(), SONAR, 0.02)
    assert keg.sizes(1.0)["length_m"] == pytest.approx(keg.sizes()["length_m"], rel=0.01)
    assert pipe.sizes(1.0) == pipe.sizes()


# ---- rows and page


def row_of(population, index, **values):
    plain = {
        "half": "development",
        "index": index,
        "family": "box",
        "complications": (),
        "contrast_db": 12.0,
        "echo_db": 8.0,
        "grazing_deg": 15.0,
        "radius_m": 60.0,
        "size_m": 1.0,
        "cell_m": 0.03,
        "voxel_m": 0.02,
        "verdict": "object",
        "objects": 1,
    }
    return population.Row(**{**plain, **values})


def body_of(population, length=1.0, half=0.018, iou=0.95, **values):
    size = {"length_m": length, "width_m": 0.5, "height_m": 0.3}
    true = {"length_m": 1.0, "width_m": 0.5, "height_m": 0.3}
    intervals = {name: (value - half, value + half) for name, value in size.items()}
    return population.BodyScore(
        **{
            "family": "box",
            "shadow_cells": 20.0,
            "hull_vs_truth": 0.95,
            "true_size": true,
            "found": True,
            "iou_hull": iou,
            "iou_truth": iou,
            "size": size,
            "intervals": intervals,
            **values,
        }
    )


def test_a_row_survives_its_line(population):
    row = row_of(
        population, 3, bodies=(body_of(population),), phantoms=((0.0, 1.0, 0.2, 0.2, 0.1),), reasons=("a",)
    )
    assert population.Row.from_json(json.loads(json.dumps(dataclasses.asdict(row)))) == row


def test_a_scene_is_wrong_where_an_extent_is_off_by_more_than_interval_and_tolerance(population):
    def wrong(length, half):
        return row_of(population, 0, bodies=(body_of(population, length, half),)).wrong()

    assert not wrong(1.0, 0.02)
    assert not wrong(1.04, 0.02)  # outside its interval, within 5 %
    assert not wrong(1.10, 0.15)  # more than 5 % off, and it says so
    assert wrong(1.10, 0.05)


def test_each_verdict_has_a_line_of_the_bodies_that_it_was_given(population):
    good = [row_of(population, i, bodies=(body_of(population),)) for i in range(3)]
    limited = row_of(
        population, 3, bodies=(body_of(population, 1.2, 0.02, iou=0.5),), quality="limited"
    )
    missed = row_of(
        population, 4, bodies=(body_of(population, found=False, iou=0.0, size={}, intervals={}),)
    )
    told = population.pages.quality_table([*good, limited, missed])[2:]
    assert [line.split(" | ")[:2] for line in told] == [["| good", "3"], ["| limited", "1"]]
    assert "| 100 % | 100 % |" in told[0]
    assert "0.50 / 0.50" in told[1]


def test_what_is_asked_is_met_and_not_met_as_the_rows_say(population):
    def verdicts(rows):
        return [line.met for line in population.pages.acceptance(rows)]

    good = [row_of(population, i, bodies=(body_of(population),)) for i in range(19)]
    off = row_of(population, 19, bodies=(body_of(population, 1.04, 0.03),))
    empty = [row_of(population, 20 + i, verdict="no object", objects=0, bodies=()) for i in range(5)]
    assert verdicts([*good, off, *empty]) == [True] * 8
    phantom = row_of(population, 30, bodies=(), phantoms=((0.0, 0.0, 1.0, 1.0, 0.1),))
    assert verdicts([*good, off, *empty, phantom])[5] is False
    missed = row_of(
        population, 31, bodies=(body_of(population, found=False, iou=0.0, size={}, intervals={}),)
    )
    assert verdicts([*good, off, missed, *empty])[6] is False
    faint = dataclasses.replace(missed, contrast_db=5.0)
    assert verdicts([*good, off, faint, *empty])[6] is True
    silent = row_of(population, 32, bodies=(body_of(population, 1.2, 0.02),))
    assert verdicts([*good, off, silent, *empty])[7] is False
    told = dataclasses.replace(silent, quality="limited")
    assert verdicts([*good, off, told, *empty])[7] is True
    assert verdicts([]) == [None] * 8


def test_a_scene_runs_is_written_down_and_is_not_run_again(population, tmp_path):
    said: list[str] = []
    index = 21  # a pole: the smallest image with an object
    rows = population.run_scenes("development", [index], tmp_path, say=said.append)
    assert said[0].startswith(f"1/1 development {index} pole: ")
    record = tmp_path / "scenes.jsonl"
    with record.open("a", encoding="utf-8") as file:
        file.write('{"half": "develop')  # it ended while it wrote this
    again = population.run_scenes("development", [index], tmp_path, say=said.append)
    assert again == rows
    assert said[1:] == ["1 of 1 scenes were done before"]
    page = tmp_path / "docs" / "page.md"
    assert population.main(["--out", str(tmp_path), "--page", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    for line in population.pages.acceptance(rows):
        assert f"| {line.wanted} | {line.measured} |" in text
    for picture in ("population_distributions", "population_dependence", "population_scene_01"):
        assert f"figures/{picture}.png" in text
        assert (page.parent / "figures" / f"{picture}.png").stat().st_size > 1000


def test_true_shadows_lose_less_than_segmented_ones_and_least_without_echoes(population, capsys):
    index = 8  # a sphere, whose undercut lies under its own echo
    told = population.losses.losses_of(index)
    assert told.family == "sphere"
    assert told.found < told.true_shadows < told.no_echoes
    assert told.no_echoes > 0.95
    assert population.losses.losses_of(1) is None  # of several bodies
    assert population.losses.main(["--only", "1", str(index), "--workers", "1"]) == 0
    table = capsys.readouterr().out.splitlines()
    assert table[2].startswith(f"| sphere | 1 | {told.found:.2f} | {told.true_shadows:.2f} |")
    assert table[-1].startswith("| **tenth percentile** | 1 |")


def test_sides_that_are_wrong_by_a_part_of_a_cell_cost_what_the_plan_says(population, drawn, capsys):
    spec = next(s for s in drawn["development"] if s.family == "box" and len(s.bodies) == 1)
    length, width = (float(side) / spec.cell_m for side in sorted(spec.meshes()[0].extents[:2]))
    (found,) = population.edges.costs_of("development", spec.index)
    for error, cost in zip(population.edges.ERRORS_CELLS, found, strict=True):
        grown = length * width / ((length + 2 * error) * (width + 2 * error))
        shrunk = (length - 2 * error) * (width - 2 * error) / (length * width)
        # A hull is wider than its box here and there, and a box that is turned has ragged sides.
        assert cost == pytest.approx((grown + shrunk) / 2, abs=0.25 * (1 - grown) + 0.005)
    assert population.edges.main(["--scenes", str(spec.index + 1), "--workers", "1"]) == 0
    told = capsys.readouterr().out
    assert all(f"| {error:g} |" in told for error in population.edges.ERRORS_CELLS)
