"""The command line, from a simulated bag to a results folder and back."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import csas_shadow_ros
from csas_shadow_ros.bags import BagReader, BagWriter, check_bag, copy, read_run, write_run
from csas_shadow_ros.cli import build_parser, main
from csas_shadow_ros.core.geometry import Acoustics, CoherentImage, Track
from csas_shadow_ros.core.parameters import STAGES
from csas_shadow_ros.parameter_file import pipeline_parameters, read_parameter_file
from csas_shadow_ros.results import ResultsError, ResultsWriter, is_results_folder, read_report
from csas_shadow_ros.results.report import _reasons, summary
from csas_shadow_ros.simulation import get_profile, simulate_bag
from csas_shadow_ros.simulation.targets import box, join_bodies
from msg_adapters.topics import STREAMS

#: Views enough for a shape, few enough for a test.
QUICK = ("--step-deg", "10", "--quiet")
ROOT = Path(csas_shadow_ros.__file__).resolve().parents[1]


class Said:
    """What a command said and how it ended."""

    def __init__(self, *arguments: object) -> None:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                self.code = main([str(a) for a in arguments])
            except SystemExit as stop:  # argparse
                self.code = int(stop.code or 0)
        self.out, self.err = out.getvalue(), err.getvalue()

    @property
    def json(self):
        return json.loads(self.out)


@pytest.fixture(scope="session")
def results(tiny_box_bag, tmp_path_factory):
    """The complete results folder of the box, by the command line."""
    out = tmp_path_factory.mktemp("results") / "box"
    said = Said("run", tiny_box_bag.path, "--out", out, *QUICK)
    assert said.code == 0, said.err
    return out


def shape_of(said: Said) -> tuple[float, float, float]:
    assert said.code == 0, said.err
    d = said.json["dimensions"]
    return d["length_m"], d["width_m"], d["height_m"]


def run_quickly(bag: Path, out: Path, *more: object) -> Said:
    return Said("run", bag, "--out", out, "--no-bag", "--no-figures", "--json", *QUICK, *more)


# -- simulate, check, info ----------------------------------------------------------------------------


def test_simulate_then_check_then_info_agree_on_the_bag(tmp_path):
    bag = tmp_path / "l"
    position = ("--position", "0.1", "-0.2")
    made = Said(
        "simulate", bag, "--profile", "tiny", "--target", "l_shape", *position, "--encoding", "16SC2",
        "--rows", "300", "--cols", "420", "--missing-arc", "40", "80", "--json",
    )  # fmt: skip
    assert made.code == 0, made.err
    assert made.json["target"] == "l_shape"
    assert Path(made.json["truth"][0]).exists()
    checked = Said("check", bag, "--json")
    told = Said("info", bag, "--json").json
    assert checked.json["ok"] == (checked.code == 0)
    assert any("missing: 40.0° to 80.0°" in f["problem"] for f in checked.json["findings"])
    assert (told["image"]["rows"], told["image"]["cols"]) == (300, 420)
    assert told["track"]["coverage_deg"] == pytest.approx(320.0)
    assert told["truth"]["dimensions"]["position_m"] == pytest.approx([0.1, -0.2], abs=1e-6)
    assert told["topics"]["/csas/image"]["bytes"] == pytest.approx(300 * 420 * 4, abs=200)
    assert told["start_from"] == ["image"]


@pytest.mark.parametrize(("target", "told"), [("cylinder", True), ("box", False)])
def test_a_target_whose_shadows_leave_the_image_by_far_is_told_of_when_it_is_simulated(
    tmp_path, target, told
):
    said = Said("simulate", tmp_path / "b", "--profile", "tiny", "--target", target)
    assert said.code == 0
    assert ("its shape will not come out" in said.err) is told


def test_info_says_in_words_what_a_bag_holds(tiny_box_bag):
    said = Said("info", tiny_box_bag.path)
    assert "512 x 512 pixels of 5 mm" in said.out
    assert "60 kHz ± 12 kHz" in said.out
    assert "720 poses over 360.0°" in said.out
    assert "0.800 x 0.400 x 0.400 m" in said.out


def test_a_sound_bag_passes_the_check_and_a_bag_without_track_fails_it_with_a_remedy(tiny_box_bag, tmp_path):
    assert Said("check", tiny_box_bag.path).code == 0
    write_run(tmp_path / "lost", tiny_box_bag.run.image, None)
    said = Said("check", tmp_path / "lost")
    assert said.code == 1
    assert "/csas/track" in said.out
    assert "Record" in said.out


def test_simulating_twice_with_one_seed_gives_the_same_bytes_and_never_replaces_a_bag_unasked(tmp_path):
    arguments = ("--profile", "tiny", "--target", "empty", "--rows", "128", "--cols", "128", "--seed", "3")
    for name in "ab":
        assert Said("simulate", tmp_path / name, *arguments).code == 0
    a, b = (read_run(tmp_path / name).image.pixels for name in "ab")
    assert np.array_equal(a, b)
    refused = Said("simulate", tmp_path / "a", *arguments)
    assert refused.code == 1
    assert "exists already" in refused.err
    assert Said("simulate", tmp_path / "a", *arguments, "--overwrite").code == 0


# -- the results folder -------------------------------------------------------------------------------


def test_the_grid_has_the_documented_arrays_and_they_agree_with_each_other(results):
    with np.load(results / "grid.npz") as grid:
        assert set(grid.files) == {
            "likelihood", "occupied", "matter", "views", "origin_m", "voxel_size_m", "threshold",
        }  # fmt: skip
        likelihood, occupied, views = grid["likelihood"], grid["occupied"], grid["views"]
        assert not (grid["matter"] & ~occupied).any()
        origin, size, threshold = grid["origin_m"], float(grid["voxel_size_m"]), float(grid["threshold"])
    assert likelihood.dtype == np.float32
    assert occupied.dtype == bool
    assert likelihood.shape == occupied.shape == views.shape
    assert views.max() <= 36
    assert (views[np.isfinite(likelihood)] > 0).all()
    assert size == pytest.approx(0.02)
    assert origin[2] == pytest.approx(size / 2)
    assert np.isfinite(threshold)
    # The occupied voxels lie where the box is.
    z, y, x = np.nonzero(occupied)
    assert origin[0] + x.mean() * size == pytest.approx(0.0, abs=0.06)
    assert origin[1] + y.mean() * size == pytest.approx(0.0, abs=0.06)
    assert z.max() * size < 0.6


@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "glb"])
def test_every_mesh_format_holds_the_same_closed_body_near_the_truth(results, kind):
    mesh = trimesh.load(str(results / f"mesh.{kind}"), force="mesh")
    mesh.merge_vertices()
    assert mesh.is_watertight
    report = read_report(results)
    assert mesh.volume == pytest.approx(report["dimensions"]["volume_m3"], rel=1e-3)
    true = trimesh.load(report["truth"]["mesh"], force="mesh")
    assert np.abs(mesh.bounds - true.bounds).max() < 0.15
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)


def test_the_report_is_strict_json_with_the_measures_the_levels_and_the_provenance(results, tiny_box_bag):
    text = (results / "report.json").read_text()
    report = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert report["object"] is True
    assert report["views"] | {"reasons": 0, "rejected_by_aspect_deg": 0} == {
        "in": 36, "used": 36, "rejected": 0, "lost": 0, "reasons": 0, "rejected_by_aspect_deg": 0,
    }  # fmt: skip
    assert report["spectrum_sign"]["verdict"] == "right"
    assert report["parameters"]["sub_aperture"]["step_deg"] == 10.0
    assert report["command"][:2] == ["csas-shadow", "run"]
    assert report["input"]["path"] == str(tiny_box_bag.path.resolve())
    assert report["input"]["metadata"]["storage_identifier"] == "mcap"
    assert {"python", "numpy", "scipy", "numba", "rosbags", "ducc0"} <= set(report["versions"])
    assert {"search", "views", "shape", "read", "write", "figures"} <= set(report["timings_s"])
    levels = report["levels"]
    assert len(levels["by_view"]) == 36
    assert sorted(round(v["aspect_deg"]) % 360 for v in levels["by_view"]) == list(range(0, 360, 10))
    assert 4.0 < levels["overall"]["contrast_db"]["median"] < 16.0
    assert sorted(report["files"]) == sorted(
        p.relative_to(results).as_posix() for p in results.rglob("*") if p.is_file()
    )


def test_scores_against_the_truth_say_how_good_the_shape_is(results):
    scores = read_report(results)["truth"]["scores"]
    assert scores["iou_truth"] > 0.6
    assert scores["iou_hull"] > 0.6
    assert scores["iou_hull_truth"] > 0.8


def test_every_object_has_its_entry_its_line_its_grid_and_its_mesh(tmp_path):
    bodies = box(0.35, 0.25, 0.2), box(0.3, 0.25, 0.15)
    for body, x in zip(bodies, (-0.6, 0.6), strict=True):
        body.apply_translation([x, 0.0, 0.0])
    bag, out = tmp_path / "two", tmp_path / "out"
    simulate_bag(bag, "tiny", join_bodies(bodies), seed=4)
    said = run_quickly(bag, out)
    report = said.json
    assert [o["number"] for o in report["objects"]] == [1, 2]
    assert report["objects"][0]["dimensions"] == report["dimensions"]
    assert report["objects"][0]["files"] == ["grid.npz", "mesh.stl"]
    second = report["objects"][1]
    assert second["position_m"] == pytest.approx([0.6, 0.0], abs=0.08)
    assert {"length_m", "height_m"} <= set(second["dimensions"]["intervals"])
    assert second["views_used"] == 36
    assert set(second["files"]) <= set(report["files"])
    mesh = trimesh.load(out / "object_2.stl", force="mesh")
    assert mesh.volume == pytest.approx(second["dimensions"]["volume_m3"], rel=1e-3)
    with np.load(out / "object_2.npz") as grid:
        assert np.count_nonzero(grid["occupied"]) == second["grid"]["occupied_voxels"]
    lines = (out / "summary.txt").read_text().splitlines()
    assert sum(line.startswith("object 2: ") for line in lines) == 1
    alone = run_quickly(bag, tmp_path / "alone", "--max-objects", 1)
    assert len(alone.json["objects"]) == 1
    assert "no more than 1" in alone.json["objects_left_out"][0]["reason"]
    assert not (tmp_path / "alone" / "object_2.stl").exists()
    # Alone it does not know of the other's echo, which takes a little of it away.
    for name in ("length_m", "width_m", "height_m"):
        assert alone.json["dimensions"][name] == pytest.approx(report["dimensions"][name], abs=0.03)
    assert run_quickly(bag, tmp_path / "none", "--max-objects", 0).code == 1


def test_the_summary_has_found_and_true_dimensions_side_by_side(results):
    lines = (results / "summary.txt").read_text().splitlines()
    length = next(line for line in lines if line.startswith("length"))
    assert "0.800 m" in length
    assert any("36 in, 36 in the grid, 0 not used, 0 lost" in line for line in lines)
    assert Said("info", results).out.startswith(lines[0])


@pytest.mark.parametrize(
    ("used", "lost", "unused"),
    [(36, 0, "0 not used, 0 lost"), (30, 0, "6 not used, 0 lost"), (33, 3, "0 not used, 3 lost")],
)
def test_a_view_that_is_in_the_grid_is_not_one_that_was_not_used(results, used, lost, unused):
    """A classifier beside the graph refused every view: "36 in the grid, 36 not used"."""
    report = read_report(results)
    reasons = {"my_classifier: not mine": 36}
    report["views"] |= {"used": used, "lost": lost, "rejected": 36, "reasons": reasons}
    lines = summary(report).splitlines()
    assert f"views: 36 in, {used} in the grid, {unused}" in lines
    assert "  36 refused, the first: my_classifier: not mine" in lines


def test_reasons_that_differ_in_numbers_alone_are_counted_under_the_first_with_its_numbers():
    gaps = [f"track gap: the track covers {n}% of the 12° aperture at aspect {n / 10}°" for n in (50, 33, 7)]
    assert _reasons([*gaps, "view is dark"]) == {gaps[0]: 3, "view is dark": 1}


def test_every_figure_is_there_and_none_is_blank(results):
    names = {p.stem for p in (results / "figures").glob("*.png")}
    assert names == {
        "figure_1b_multilook", "figure_1c_color_by_aspect", "figure_2a_spectrum", "figure_2b_slider",
        "figure_3_sub_apertures", "figure_5_enhancement", "figure_6_enhanced", "figure_7_segmentation",
        "figure_8_surfaces",
    }  # fmt: skip
    for path in (results / "figures").glob("*.png"):
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 400
        assert picture.std() > 10.0, path.name
        # Something is drawn in every ninth of the middle, not only a frame.
        rows, cols = (n // 3 for n in picture.shape[:2])
        assert picture[rows : 2 * rows, cols : 2 * cols].std() > 5.0, path.name


def test_the_result_bag_honours_the_contract_and_holds_every_stage(results):
    path = results / "result.mcap"
    report = check_bag(path)
    assert report.ok, str(report)
    counts = read_run(path).counts
    expected = set(STREAMS) - {"sector"}
    assert set(counts) == expected
    assert all(counts[s] == 36 for s in ("sub_aperture", "shadow", "likelihood", "shadow_mask"))
    reader = BagReader(path)
    assert {"/csas/track", "/csas/mesh", "/csas/voxels", "/csas/target"} <= set(reader.topics)


def test_the_image_is_in_the_result_bag_byte_for_byte(results, tiny_box_bag):
    def images(path):
        return [bytes(m.cdr) for m in BagReader(path).messages(["image"])]

    assert images(results / "result.mcap") == images(tiny_box_bag.path)


# -- other starts, parameters -------------------------------------------------------------------------


@pytest.mark.parametrize("stage", [pytest.param("sub_aperture", marks=pytest.mark.long), "shadow"])
def test_a_run_from_recorded_views_gives_the_shape_of_the_run_from_the_image(results, tmp_path, stage):
    said = run_quickly(results / "result.mcap", tmp_path / "r", "--start-from", stage)
    whole = read_report(results)["dimensions"]
    length, width, height = shape_of(said)
    assert said.json["stage"] == stage
    assert length == pytest.approx(whole["length_m"], abs=0.05)
    assert width == pytest.approx(whole["width_m"], abs=0.05)
    assert height == pytest.approx(whole["height_m"], abs=0.05)


def test_recorded_masks_carve_the_same_grid_as_the_run_that_made_them(results, tmp_path):
    report = read_report(results)
    x, y = report["target"]["position_m"]
    place = ("--position-m", x, y, "--size-m", *report["target"]["size_m"])
    only = tmp_path / "masks"
    with BagWriter(only) as writer:
        copy(BagReader(results / "result.mcap"), writer, lambda m: "/shadow_mask/" in m.topic)
    said = run_quickly(only, tmp_path / "r", *place)
    assert said.json["stage"] == "shadow_mask"
    with np.load(results / "grid.npz") as a, np.load(tmp_path / "r" / "grid.npz") as b:
        for name in a.files:
            assert np.array_equal(a[name], b[name], equal_nan=True), name


def test_a_hollow_is_told_of_in_the_grid_the_report_the_summary_and_a_surface_of_its_own(tmp_path):
    bag, out = tmp_path / "tyre", tmp_path / "r"
    assert Said("simulate", bag, "--profile", "tiny", "--target", "tyre", "--seed", "5").code == 0
    said = run_quickly(bag, out, "--step-deg", "5")
    assert said.code == 0, said.err
    hollows = said.json["hollows"]
    with np.load(out / "grid.npz") as grid:
        assert np.count_nonzero(grid["occupied"] & ~grid["matter"]) == hollows["voxels"] > 0
        assert hollows["volume_m3"] == pytest.approx(hollows["voxels"] * float(grid["voxel_size_m"]) ** 3)
    assert hollows["iou_truth"]["occupied"] == said.json["truth"]["scores"]["iou_truth"]
    assert hollows["iou_truth"]["matter"] > hollows["iou_truth"]["occupied"]
    assert "hollows that no shadow shows" in (out / "summary.txt").read_text(encoding="utf-8")
    assert "mesh_matter.stl" in said.json["files"]
    whole, matter = (trimesh.load(out / f"{name}.stl").volume for name in ("mesh", "mesh_matter"))
    assert 0.0 < matter < whole


def test_without_a_hollow_there_is_one_surface_alone(results):
    assert read_report(results)["hollows"]["voxels"] == 0
    assert not (results / "mesh_matter.stl").exists()
    assert "hollows" not in (results / "summary.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "stage", ["sub_aperture", pytest.param("shadow", marks=pytest.mark.long), "shadow_mask"]
)
def test_views_of_a_result_leave_the_same_result_from_every_stage(results, tmp_path, stage):
    said = run_quickly(results / "result.mcap", tmp_path / "r", "--start-from", stage)
    assert said.code == 0, said.err
    first, again = read_report(results), read_report(tmp_path / "r")
    assert (again["verdict"], again["quality"]) == (first["verdict"], first["quality"])
    for name in ("likelihood", "occupied"):
        a, b = (np.load(folder / "grid.npz")[name] for folder in (results, tmp_path / "r"))
        assert np.array_equal(a, b, equal_nan=True)
    if stage != "shadow_mask":  # of silhouettes alone the levels are not known that sides are measured on
        assert again["dimensions"] == first["dimensions"]
        # The bag of a result holds no truth.
        assert [{**one, "truth": None} for one in again["objects"]] == [
            {**one, "truth": None} for one in first["objects"]
        ]
        assert again["objects_left_out"] == first["objects_left_out"]


def test_masks_alone_without_a_given_target_are_refused_with_what_to_give(results, tmp_path):
    with BagWriter(tmp_path / "b") as writer:
        reader = BagReader(results / "result.mcap")
        for message in reader.messages(["shadow_mask/image", "shadow_mask/camera_info"]):
            writer.write(message.topic, message.decode())
    said = run_quickly(tmp_path / "b", tmp_path / "r")
    assert said.code == 1
    assert "position_m and size_m" in said.err
    assert not (tmp_path / "r").exists()


def test_every_core_parameter_is_an_option_with_its_bounds_in_the_help(capsys):
    with pytest.raises(SystemExit):
        build_parser().parse_args(["run", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for kind in STAGES.values():
        for field in dataclasses.fields(kind):
            assert f"--{field.name.replace('_', '-')}" in text
    assert "0.5 to 90 deg; default 12 deg" in text


def test_options_override_the_parameter_file_and_the_shipped_file_is_the_defaults(tiny_empty_bag, tmp_path):
    shipped = ROOT / "config" / "csas_shadow.yaml"
    assert pipeline_parameters(read_parameter_file(shipped)) == pipeline_parameters({})
    own = tmp_path / "p.yaml"
    own.write_text(
        "/**/sub_aperture:\n  ros__parameters:\n    step_deg: 30.0\n    aperture_deg: 10.0\n    window: 2\n"
    )
    said = run_quickly(tiny_empty_bag.path, tmp_path / "r", "--params", own, "--aperture-deg", "9")
    used = said.json["parameters"]["sub_aperture"]
    assert (used["step_deg"], used["aperture_deg"]) == (10.0, 9.0)  # QUICK's step is an option too


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/**:\n  ros__parameters:\n    aperture_degrees: 3.0\n", "unknown parameter 'aperture_degrees'"),
        ("/**/shadow:\n  ros__parameters: {}\n", "unknown node 'shadow'"),
        ("sub_aperture:\n  ros__parameters:\n    step_deg: 720.0\n", "step_deg is 720.0 deg"),
        ("aperture_deg: 3.0\n", "expected ROS 2's layout"),
        (
            "/**/sub_aperture:\n  ros__parameters:\n    target: given\n    position_m: [1.0, 2.0]\n"
            "/**/voxel_carver:\n  ros__parameters:\n    position_m: [3.0, 4.0]\n",
            "position_m is [1.0, 2.0] for sub_aperture and [3.0, 4.0] for voxel_carver",
        ),
    ],
)
def test_a_parameter_file_that_is_wrong_is_refused_by_name(tmp_path, tiny_empty_bag, text, expected):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    said = run_quickly(tiny_empty_bag.path, tmp_path / "r", "--params", path)
    assert said.code == 1
    assert expected in said.err


# -- what a run must say ------------------------------------------------------------------------------


def test_an_empty_seabed_is_a_result_that_says_no_object(tiny_empty_bag, tmp_path):
    out = tmp_path / "r"
    said = Said("run", tiny_empty_bag.path, "--out", out, *QUICK)
    assert said.code == 0
    assert "no object" in said.out.splitlines()[0]
    report = read_report(out)
    assert report["object"] is False
    assert report["dimensions"] is None
    assert not list(out.glob("mesh.*"))
    with np.load(out / "grid.npz") as grid:
        assert not grid["occupied"].any()
        assert np.isnan(grid["likelihood"]).all()
    assert "no target" in report["figures_left_out"]["figure_7_segmentation"]
    assert (out / "figures" / "figure_1b_multilook.png").exists()
    assert "/csas/mesh" in BagReader(out / "result.mcap").topics  # it says DELETE


def encoded(image: CoherentImage, sign: int) -> CoherentImage:
    """Return the image as a processor of the other phase convention makes it."""
    if sign == image.acoustics.spectrum_sign:
        return image
    acoustics = dataclasses.replace(image.acoustics, spectrum_sign=sign)
    return dataclasses.replace(image, pixels=np.conj(image.pixels), acoustics=acoustics)


@pytest.mark.parametrize(("encoding", "sign"), [("8SC2", -1), ("16SC2", 1), ("64FC2", -1)])
def test_encodings_and_signs_give_the_shape_of_the_float_image(
    tiny_box_bag, results, tmp_path, encoding, sign
):
    write_run(
        tmp_path / "b", encoded(tiny_box_bag.run.image, sign), tiny_box_bag.run.track, encoding=encoding
    )
    found = shape_of(run_quickly(tmp_path / "b", tmp_path / "r"))
    whole = read_report(results)["dimensions"]
    assert found == pytest.approx((whole["length_m"], whole["width_m"], whole["height_m"]), abs=0.05)


def test_a_rectangular_image_with_its_middle_off_the_origin_gives_the_shape_too(tmp_path):
    wide = get_profile("tiny", cols=640, rows=560, centre_m=(0.15, -0.1))
    simulate_bag(tmp_path / "b", wide, "box", seed=5, heading_deg=20.0)
    length, width, height = shape_of(run_quickly(tmp_path / "b", tmp_path / "r"))
    # A resolution cell of this band is 0.1 m at 12 degrees.
    assert length == pytest.approx(0.8, abs=0.15)
    assert width == pytest.approx(0.4, abs=0.2)
    assert height == pytest.approx(0.4, abs=0.12)


def test_a_wrong_spectrum_sign_is_named_and_can_be_overridden_with_a_notice(tiny_box_bag, tmp_path):
    image = tiny_box_bag.run.image
    wrong = dataclasses.replace(image.acoustics, spectrum_sign=-1)
    write_run(tmp_path / "b", dataclasses.replace(image, acoustics=wrong), tiny_box_bag.run.track)
    refused = run_quickly(tmp_path / "b", tmp_path / "r")
    assert refused.code == 1
    assert "spectrum_sign is -1" in refused.err
    assert "expected +1" in refused.err
    assert "run with --spectrum-sign +1" in refused.err
    assert not (tmp_path / "r").exists()
    said = Said(
        "run", tmp_path / "b", "--out", tmp_path / "r", "--no-bag", "--no-figures", "--step-deg", "30",
        "--spectrum-sign", "1",
    )  # fmt: skip
    assert said.code == 0
    assert "the bag states -1, +1 is used" in said.err
    assert "overridden to +1" in said.out
    assert read_report(tmp_path / "r")["spectrum_sign"]["override"] == 1


def spoilt(bag, tmp_path, stated=None, poses=slice(None)):
    """Write the box's run with another band or with fewer poses."""
    image, track = bag.run.image, bag.run.track
    image = dataclasses.replace(image, acoustics=stated or image.acoustics)
    return write_run(tmp_path / "b", image, Track(track.stamps_ns[poses], track.positions_m[poses]))


@pytest.mark.parametrize("command", ["run", "replay"])
def test_a_band_that_the_image_contradicts_is_refused_and_not_called_no_object(
    tiny_box_bag, tmp_path, command
):
    bag = spoilt(tiny_box_bag, tmp_path, stated=Acoustics(60.0, 24.0, 1500.0, 1))  # kHz, not Hz
    said = Said(command, bag, "--out", tmp_path / "r", *QUICK)
    assert said.code == 1
    assert said.err.count("\n") == 1
    assert "of the image's energy lies in its stated band" in said.err
    assert "no object" not in said.out
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("poses", "expected"),
    [
        (slice(19, None, 20), "no view can be made; its poses lie "),
        (slice(-20, None), "none of 36 views could be made"),
    ],
    ids=["too far apart", "too short an arc"],
)
def test_a_track_of_which_no_view_can_be_made_is_refused_and_not_called_no_object(
    tiny_box_bag, tmp_path, poses, expected
):
    said = run_quickly(spoilt(tiny_box_bag, tmp_path, poses=poses), tmp_path / "r")
    assert said.code == 1
    assert expected in said.err
    assert "no object" not in said.out
    assert not (tmp_path / "r").exists()


def test_views_of_which_none_is_usable_are_refused_with_the_first_ones_fault(results, tmp_path):
    with BagWriter(tmp_path / "b") as writer:
        for message in BagReader(results / "result.mcap").messages(["shadow/image", "shadow/camera_info"]):
            decoded = message.decode()
            if message.topic.endswith("camera_info"):
                decoded.d = decoded.d[:4]
            writer.write(message.topic, decoded)
    said = run_quickly(tmp_path / "b", tmp_path / "r")
    assert said.code == 1
    assert "none of the 36 shadow views is usable" in said.err
    assert "shadow/camera_info.d has 4 entries; expected 9" in said.err


def test_a_failed_run_says_one_line_without_a_traceback_and_debug_shows_it(tmp_path):
    arguments = [sys.executable, "-m", "csas_shadow_ros.cli", "run", "nowhere", "--out", str(tmp_path / "r")]
    options = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": 120}
    plain = subprocess.run(arguments, **options)
    assert plain.returncode == 1
    assert plain.stdout == ""
    assert plain.stderr == "csas-shadow: error: there is no bag at nowhere\n"
    with pytest.raises(Exception, match="there is no bag at nowhere"):
        main(["run", "nowhere", "--out", str(tmp_path / "r"), "--debug"])


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (("--bogus", "3"), 2, "unrecognized arguments: --bogus 3"),
        (("--aperture-deg", "500"), 1, "aperture_deg is 500.0 deg; expected a number in [0.5, 90] deg"),
        (("--aperture-deg", "wide"), 2, "invalid float value: 'wide'"),
        (("--step-deg", "7"), 1, "360"),
        (("--method", "magic"), 2, "invalid choice: 'magic'"),
        (("--workers", "0"), 1, "workers is 0; expected 1 or more"),
        (("--start-from", "likelihood"), 1, "holds no likelihood views"),
        (("--params", "nowhere.yaml"), 1, "'nowhere.yaml' cannot be read"),
    ],
)
def test_a_wrong_option_is_refused_by_name(tiny_empty_bag, tmp_path, arguments, code, expected):
    said = Said("run", tiny_empty_bag.path, "--out", tmp_path / "r", *arguments)
    assert said.code == code
    assert expected in said.err
    assert "Traceback" not in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_bag_without_its_camera_info_is_refused_with_what_is_missing(tiny_box_bag, tmp_path):
    with BagWriter(tmp_path / "b") as writer:
        copy(BagReader(tiny_box_bag.path), writer, lambda m: not m.topic.endswith("camera_info"))
    said = run_quickly(tmp_path / "b", tmp_path / "r")
    assert said.code == 1
    assert "no camera_info of the same stamp on /csas/camera_info" in said.err


def test_version_and_help_go_to_stdout_with_examples():
    version = Said("--version")
    assert version.code == 0
    assert version.out == f"csas-shadow {csas_shadow_ros.__version__}\n"
    text = Said("--help").out
    for word in (
        "simulate",
        "check",
        "info",
        "run",
        "replay",
        "csas-shadow run box_run --out box_results",
        "metres",
    ):
        assert word in text


# -- the folder is whole or not there -----------------------------------------------------------------


def test_a_results_folder_is_replaced_only_when_asked_and_nothing_else_ever_is(tiny_empty_bag, tmp_path):
    out, mine = tmp_path / "r", tmp_path / "mine"
    assert run_quickly(tiny_empty_bag.path, out).code == 0
    before = (out / "report.json").read_bytes()
    refused = run_quickly(tiny_empty_bag.path, out)
    assert refused.code == 1
    assert "--overwrite" in refused.err
    assert (out / "report.json").read_bytes() == before
    assert run_quickly(tiny_empty_bag.path, out, "--overwrite", "--step-deg", "30").code == 0
    assert (out / "report.json").read_bytes() != before
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    refused = run_quickly(tiny_empty_bag.path, mine, "--overwrite")
    assert refused.code == 1
    assert "not a results folder: not replaced" in refused.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "r"]


def test_a_run_that_breaks_leaves_nothing_behind(tmp_path):
    writer = ResultsWriter(tmp_path / "r")
    with pytest.raises(RuntimeError, match="power cut"), writer:
        raise RuntimeError("power cut")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="not a results folder"):
        ResultsWriter(tmp_path / "file", overwrite=True)
    assert not is_results_folder(tmp_path)


# -- through the node graph ---------------------------------------------------------------------------


def test_replay_leaves_the_folder_that_run_leaves_with_the_same_grid(tiny_box_bag, tmp_path):
    pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    step = ("--step-deg", "30", "--quiet")
    replayed = Said("replay", tiny_box_bag.path, "--out", tmp_path / "graph", *step)
    assert replayed.code == 0, replayed.err
    assert run_quickly(tiny_box_bag.path, tmp_path / "process", *step).code == 0
    with np.load(tmp_path / "graph" / "grid.npz") as a, np.load(tmp_path / "process" / "grid.npz") as b:
        for name in a.files:
            assert np.array_equal(a[name], b[name], equal_nan=True), name
    report = read_report(tmp_path / "graph")
    assert report["through"] == "node graph"
    assert (report["views"]["in"], report["views"]["used"], report["views"]["lost"]) == (12, 12, 0)
    assert len(report["levels"]["by_view"]) == 12
    assert report["truth"]["scores"]["iou_truth"] > 0.3
    assert report["figures_left_out"] == {}
    counts = read_run(tmp_path / "graph" / "result.mcap").counts
    assert all(counts[s] == 12 for s in ("sub_aperture", "shadow", "likelihood", "shadow_mask"))
    assert counts["voxel_grid"] == 1
    assert {"sub_aperture", "voxel_carver"} <= set(report["nodes"])
    assert (tmp_path / "graph" / "log" / "voxel_carver.log").exists()


EARLY_INTERRUPT = """
import os, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background is born without

def find_spec(name, path=None, target=None):
    if name == "csas_shadow_ros.core.errors":
        os.kill(os.getpid(), signal.SIGINT)
        sum(range(1000))

sys.meta_path.insert(0, type("Interrupter", (), {"find_spec": staticmethod(find_spec)}))
from csas_shadow_ros.__main__ import main
main()
"""


def test_an_interrupt_before_the_command_line_is_there_ends_in_one_line():
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", EARLY_INTERRUPT],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (1, "csas-shadow: error: interrupted\n")


def test_the_package_runs_as_a_module():
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-m", "csas_shadow_ros", "--version"],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0
    assert done.stdout.startswith("csas-shadow ")


def test_warm_tells_what_it_compiled_and_where_that_is_kept():
    said = Said("warm", "--json")
    assert said.code == 0, said.err
    told = said.json
    assert told["compiled"] + told["loaded"] > 30
    assert Path(told["folder"]).is_dir()
    again = Said("warm")
    assert told["folder"] in again.out


@pytest.mark.parametrize(
    "arguments", [(), ("run",), ("replay",), ("check",), ("view",), ("warm",), ("keys",)]
)
def test_help_comes_before_any_numerical_library(arguments):
    code = (
        "import sys; from csas_shadow_ros.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'scipy', 'numba', 'cv2', 'rosbags', 'yaml'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code, *arguments, "--help"]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert told.splitlines()[-1] == "[]"
