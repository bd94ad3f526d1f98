"""The accuracy benchmark itself: it resumes, keeps floors, and says met only of what the numbers bear out."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.simulation import shadow_hull, simulate, voxelise_truth

ROOT = Path(__file__).resolve().parents[2]
QUICK = ["--profile", "tiny", "--step-deg", "15"]
SIZE = {"length_m": 0.8, "width_m": 0.4, "height_m": 0.4, "volume_m3": 0.128}
VOXEL_M = 0.02


#: The first run is dear: one worker makes it.
of_first_run = pytest.mark.xdist_group("first run")


@pytest.fixture(scope="session")
def settings(accuracy):
    return accuracy.Settings("tiny", 15.0, (accuracy.WITH_FFSE,))


@pytest.fixture(scope="session")
def cases(accuracy):
    return accuracy.plan(("box", accuracy.EMPTY), (2,), ("clean", "contrast"), empty_seabeds=1)


@pytest.fixture(scope="session")
def first_run(accuracy, settings, cases, tmp_path_factory):
    record = tmp_path_factory.mktemp("accuracy") / "first.jsonl"
    said: list[str] = []
    rows = accuracy.run_cases(cases, settings, record, say=said.append)
    return rows, record.read_text(encoding="utf-8"), said


def without_time(rows):
    return [row.to_json(timed=False) for row in rows]


# ---- rows as they come


@of_first_run
def test_every_case_is_written_down_and_reported_as_it_is_done(first_run, cases):
    rows, written, said = first_run
    assert [row.case for row in rows] == cases
    assert len(written.splitlines()) == len(said) == len(cases)
    assert said[0].startswith(f"1/{len(cases)} box, seed 2, clean: IoU 0.")
    assert said[1].startswith(f"2/{len(cases)} empty, seed 1, clean: no object")


@of_first_run
def test_an_interrupted_run_goes_on_after_the_last_whole_row(accuracy, settings, cases, first_run, tmp_path):
    rows, written, _ = first_run
    first, second, _ = written.splitlines()
    record = tmp_path / "run.jsonl"
    record.write_text(first + "\n" + second[: len(second) // 2], encoding="utf-8")
    said: list[str] = []
    again = accuracy.run_cases(cases, settings, record, resume=True, say=said.append)
    assert said[0].startswith(f"1 of {len(cases)} ")
    assert [text.split(":")[0] for text in said[1:]] == [
        "2/3 empty, seed 1, clean",
        "3/3 box, seed 2, contrast",
    ]
    assert without_time(again) == without_time(rows)
    assert set(accuracy.read_rows(record, settings)) == set(cases)


@of_first_run
def test_a_run_that_was_complete_scores_nothing_again(accuracy, settings, cases, first_run, tmp_path):
    rows, written, _ = first_run
    record = tmp_path / "run.jsonl"
    record.write_text(written, encoding="utf-8")
    said: list[str] = []
    assert accuracy.run_cases(cases, settings, record, resume=True, say=said.append) == rows
    assert len(said) == 1


@of_first_run
def test_rows_of_other_settings_or_other_code_are_not_taken(
    accuracy, settings, first_run, tmp_path, monkeypatch
):
    _, written, _ = first_run
    record = tmp_path / "run.jsonl"
    record.write_text(written, encoding="utf-8")
    assert len(accuracy.read_rows(record, settings)) == 3
    assert not accuracy.read_rows(record, dataclasses.replace(settings, step_deg=12.0))
    monkeypatch.setattr(accuracy, "code_fingerprint", lambda: "other")
    assert not accuracy.read_rows(record, settings)


def test_a_row_survives_json(accuracy):
    score = accuracy.Score("consensus", "exact", 0.9, 0.8, 0.04, SIZE, {"length_m": (0.7, 0.9)})
    row = accuracy.Row(accuracy.Case("box", 1), True, 0.93, SIZE, (score,), "", 3.5)
    assert accuracy.Row.from_json(json.loads(json.dumps(row.to_json(timed=True)))) == row


@pytest.mark.long
def test_two_processes_write_the_same_files_as_one(accuracy, tmp_path):
    arguments = [*QUICK, "--targets", "box", "--seeds", "1", "--conditions", "clean", "phase"]
    one, two = tmp_path / "one" / "page.md", tmp_path / "two" / "page.md"
    assert accuracy.main([*arguments, "--jobs", "1", "--out", str(one)]) == 0
    command = [sys.executable, str(accuracy.__file__), *arguments, "--jobs", "2", "--out", str(two)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    assert "2/2 " in done.stderr
    names = ["page.md", "page.json", "figures/accuracy_iou.png", "figures/accuracy_methods.png"]
    for name in names:
        assert (one.parent / name).read_bytes() == (two.parent / name).read_bytes(), name
    assert not list(tmp_path.rglob("*.jsonl"))


# ---- scores


def test_what_the_volume_cuts_off_counts_as_missed(accuracy):
    run = simulate("tiny", "box", seed=1)
    half = Volume.around((0.2, 0.0), (0.4, 0.4, 0.4), VOXEL_M)
    full = np.ones(half.shape, bool)
    nothing = np.zeros(half.shape, np.float32)
    grid = VoxelGrid(half, nothing, nothing.astype(np.uint16), 0.1, full)
    _, to_truth = accuracy._Truth(run).scores_of(grid)
    assert to_truth == pytest.approx(0.5)


def test_the_wider_lattice_holds_the_target_and_keeps_the_voxels_where_they_are(accuracy):
    mesh = simulate("tiny", "box", seed=1, position_m=(0.1, -0.2), heading_deg=33.0).truth.target
    volume = Volume.around((0.3, 0.0), (0.5, 0.9, 0.3), VOXEL_M)
    wide, inside = accuracy.lattice_over(volume, mesh)
    for axis, index in (("x_m", 2), ("y_m", 1), ("z_m", 0)):
        np.testing.assert_allclose(getattr(wide, axis)[inside[index]], getattr(volume, axis), atol=1e-12)
    hull = shadow_hull(
        mesh, [[75.0, 0.0, 18.0], [-75.0, 0.0, 18.0], [0.0, 75.0, 18.0], [0.0, -75.0, 18.0]], wide
    )
    truth = voxelise_truth(mesh, wide)
    assert truth.sum() * VOXEL_M**3 == pytest.approx(mesh.volume, rel=0.02)
    assert not (truth & ~hull).any()


@of_first_run
def test_a_tiny_run_scores_every_method_and_finds_the_box_about_where_it_is(accuracy, first_run):
    clean = first_run[0][0]
    assert clean.found
    assert {score.method for score in clean.scores} == set(accuracy.METHODS)
    assert all(0.3 < score.iou_hull <= 1.0 for score in clean.scores)
    for name, value in SIZE.items():
        assert clean.true_size[name] == pytest.approx(value, abs=1e-5)


def test_intervals_are_taken_from_the_dimensions_that_give_them_and_none_from_those_that_do_not(accuracy):
    given = {"length_m": (0.7, 0.9), "volume_m3": (0.1, 0.2)}
    assert accuracy._intervals(SimpleNamespace(intervals=given)) == given
    assert accuracy._intervals(SimpleNamespace(intervals={})) == {}
    assert accuracy._intervals(SimpleNamespace()) == {}


# ---- met or not met


def rows_of(accuracy, ious, *, condition="clean", size=SIZE, intervals=None, truth=0.7):
    rows = []
    for target, values in ious.items():
        for seed, value in enumerate(values, start=1):
            score = accuracy.Score("consensus", "exact", value, truth, 0.04, size, intervals or {})
            rows.append(accuracy.Row(accuracy.Case(target, seed, condition), True, 0.9, SIZE, (score,)))
    return rows


def verdicts(accuracy, rows):
    lines = accuracy.acceptance(rows, VOXEL_M)
    keys = (
        "mean",
        "lowest",
        "tyre",
        "frame",
        "sizes",
        "intervals",
        "contrast",
        "arc",
        "track",
        "phase",
        "empty",
    )
    return dict(zip(keys, lines, strict=True))


def test_nothing_is_said_of_what_was_not_measured(accuracy):
    lines = accuracy.acceptance([], VOXEL_M)
    assert {(line.measured, line.met) for line in lines} == {("not measured", None)}
    assert verdicts(accuracy, rows_of(accuracy, {"box": [0.9]}))["intervals"].met is None


def test_the_mean_and_the_lowest_count_every_compact_target_and_no_clutter(accuracy):
    rows = rows_of(accuracy, {"box": [0.95, 0.93], "frame": [0.81], "frame_grid": [0.3]})
    found = verdicts(accuracy, rows)
    assert not found["mean"].met
    assert found["mean"].measured == "0.897 (2 targets, 3 cases)"
    assert found["lowest"].met
    assert found["lowest"].measured == "0.810 (frame, seed 1)"
    better = verdicts(accuracy, rows_of(accuracy, {"box": [1.0, 1.0], "frame": [0.79]}))
    assert better["mean"].met
    assert not better["lowest"].met


def test_a_target_that_was_not_found_counts_as_zero(accuracy):
    rows = rows_of(accuracy, {"box": [1.0]})
    missed = accuracy.Row(
        accuracy.Case("cone", 1), False, 0.9, SIZE, (accuracy.Score("consensus", "exact", 0.0, 0.0),)
    )
    found = verdicts(accuracy, [*rows, missed])
    assert found["lowest"].measured == "0.000 (cone, seed 1)"
    assert found["sizes"].measured == "50 % (3 of 6)"
    assert "No object: cone, seed 1, clean." in "\n".join(accuracy.condition_table([missed], "clean"))


def test_ring_and_frame_are_held_to_the_truth_in_every_case(accuracy):
    rows = rows_of(accuracy, {"tyre": [0.9]}, truth=0.59) + rows_of(accuracy, {"frame": [0.9]}, truth=0.61)
    found = verdicts(accuracy, rows)
    assert (found["tyre"].met, found["frame"].met) == (False, True)


def test_a_size_may_be_off_by_five_per_cent_or_a_voxel_whichever_is_larger(accuracy):
    size = {**SIZE, "length_m": 0.839, "width_m": 0.421}  # 4.9 %; more than 5 % and than a voxel
    (row,) = rows_of(accuracy, {"box": [0.9]}, size=size)
    assert accuracy.sizes_within(row, VOXEL_M) == [True, False, True]
    assert accuracy.sizes_within(row, 0.03) == [True, True, True]
    assert verdicts(accuracy, [row])["sizes"].measured == "67 % (2 of 3)"


def test_coverage_counts_the_intervals_that_are_given(accuracy):
    intervals = {"length_m": (0.79, 0.85), "width_m": (0.41, 0.45)}
    (row,) = rows_of(accuracy, {"box": [0.9]}, intervals=intervals)
    assert accuracy.intervals_hold(row) == [True, False]
    line = verdicts(accuracy, [row])["intervals"]
    assert (line.met, line.measured) == (False, "50 % (1 of 2)")


def test_a_condition_is_compared_with_the_same_targets_and_seeds(accuracy):
    rows = rows_of(accuracy, {"box": [0.9, 0.8], "cone": [0.9]})
    rows += rows_of(accuracy, {"box": [0.78]}, condition="contrast")
    rows += rows_of(accuracy, {"box": [0.85]}, condition="phase")
    found = verdicts(accuracy, rows)
    assert (found["contrast"].met, found["contrast"].measured) == (False, "0.120 (to 0.780)")
    assert (found["phase"].met, found["phase"].measured) == (True, "0.050 (to 0.850)")
    assert found["arc"].met is None


def test_one_object_on_an_empty_seabed_is_too_many(accuracy):
    rows = [accuracy.Row(accuracy.Case("empty", seed), found=seed == 3) for seed in range(1, 6)]
    line = verdicts(accuracy, rows)["empty"]
    assert (line.met, line.measured) == (False, "4 of 5")


def test_the_page_holds_every_verdict_and_a_table_for_each_condition(accuracy):
    rows = rows_of(accuracy, {"box": [0.9], "frame_grid": [0.5]})
    rows += rows_of(accuracy, {"box": [0.7]}, condition="phase")
    text = accuracy.page(rows, accuracy.Settings(), ["--seeds", "1"], [])
    for line in accuracy.acceptance(rows, VOXEL_M):
        assert f"| {line.wanted} | {line.measured} |" in text
    assert "    python benchmarks/accuracy.py --seeds 1\n" in text
    assert "### Phase error of 1 rad" in text
    assert "### Contrast" not in text
    assert "frame_grid (clutter, not in the mean)" in text


# ---- the short form


def test_the_short_form_fails_below_its_floor_and_names_case_value_and_floor(accuracy, tmp_path, capsys):
    floor = tmp_path / "floor.json"
    short = ["--short", *QUICK, "--targets", "tyre", "--floor", str(floor)]
    assert accuracy.main(short) == 2
    assert f"{floor} does not exist" in capsys.readouterr().err
    assert accuracy.main([*short, "--write-floor"]) == 0
    held = json.loads(floor.read_text(encoding="utf-8"))
    assert list(held["iou_hull"]) == ["tyre, seed 2, clean"]
    assert accuracy.main(short) == 0
    value = held["iou_hull"]["tyre, seed 2, clean"]
    held["iou_hull"]["tyre, seed 2, clean"] = round(value + 0.03, 4)
    floor.write_text(json.dumps(held), encoding="utf-8")
    capsys.readouterr()
    assert accuracy.main(short) == 1
    message = capsys.readouterr().err
    assert (
        f"tyre, seed 2, clean: IoU with the hull is {value:.4f}; expected at least {value + 0.03:.4f}"
        in message
    )


def test_a_small_fall_is_allowed_and_a_larger_one_is_not(accuracy):
    settings = accuracy.Settings(step_deg=accuracy.SHORT_STEP_DEG)
    floor = accuracy.floor_of(rows_of(accuracy, {"box": [0.9]}), settings)
    assert not accuracy.below_floor(rows_of(accuracy, {"box": [0.881]}), settings, floor)
    assert len(accuracy.below_floor(rows_of(accuracy, {"box": [0.879]}), settings, floor)) == 1


def test_an_extent_that_was_right_must_stay_right(accuracy):
    settings = accuracy.Settings(step_deg=accuracy.SHORT_STEP_DEG)
    low = SIZE | {"height_m": 0.37}
    floor = accuracy.floor_of(rows_of(accuracy, {"box": [0.9]}), settings)
    (message,) = accuracy.below_floor(rows_of(accuracy, {"box": [0.9]}, size=low), settings, floor)
    assert message == "box, seed 1, clean: height_m is 0.370; expected 0.400 within 5 % or a voxel"
    (message, *_) = accuracy.below_floor(rows_of(accuracy, {"box": [0.9]}, size={}), settings, floor)
    assert "length_m is not known" in message
    was_wrong = accuracy.floor_of(rows_of(accuracy, {"box": [0.9]}, size=low), settings)
    assert not accuracy.below_floor(rows_of(accuracy, {"box": [0.9]}, size=low), settings, was_wrong)


def test_a_floor_of_other_settings_or_without_the_case_is_refused(accuracy):
    settings = accuracy.Settings(step_deg=accuracy.SHORT_STEP_DEG)
    floor = accuracy.floor_of(rows_of(accuracy, {"box": [0.9]}), settings)
    with pytest.raises(accuracy.AccuracyError, match="no value for cone, seed 1, clean"):
        accuracy.below_floor(rows_of(accuracy, {"cone": [0.9]}), settings, floor)
    with pytest.raises(accuracy.AccuracyError, match=r"step_deg is 6\.0, the run's 3\.0"):
        accuracy.below_floor([], accuracy.Settings(), floor)


def test_the_committed_floor_names_the_short_forms_cases(accuracy):
    floor = json.loads(accuracy.FLOOR.read_text(encoding="utf-8"))
    assert list(floor["iou_hull"]) == [str(case) for case in accuracy.short_cases()]
    for case in accuracy.short_cases():
        if case.condition == "clean":
            assert floor["sizes_right"][str(case)] == list(accuracy.SIZES)
    assert accuracy.below_floor([], accuracy.Settings(step_deg=accuracy.SHORT_STEP_DEG), floor) == []
