"""One frame a run, whichever it is, and the origin that a bag says it has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csas_shadow_ros.bags import check_bag, read_run, write_run
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import BagError, GeometryError, TrackError, ViewError
from csas_shadow_ros.core.geometry import Datum, Origin, Track, TrackBook, TrackPiece
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import process
from csas_shadow_ros.core.reconstruction import Reconstruction
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.shape.volume import Target
from csas_shadow_ros.from_bag import reconstruct_run
from msg_adapters import RosbagsMessages, origin_to_msg, view_to_msgs

DATUM = Datum(48.0, -4.5, covariance_m2=(4.0, 4.0, 0.0))
COARSE = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=20.0), carving=CarvingParameters(voxel_size_m=0.08)
)


def in_frame(track: Track, frame: str) -> Track:
    return Track(track.stamps_ns, track.positions_m, max_gap_rad=track.max_gap_rad, frame=frame)


def test_any_frame_is_taken_that_a_run_uses_throughout(tmp_path: Path, tiny_box_bag) -> None:
    made = tiny_box_bag.run
    image, track = replace(made.image, frame="auv/scene"), in_frame(made.track, "auv/scene")
    bag = write_run(tmp_path / "bag", image, track, datum=DATUM)
    report = check_bag(bag)
    assert report.ok
    assert f"{DATUM}" in {f.problem for f in report.findings if f.topic == "/csas/origin"}
    run = read_run(bag)
    assert (run.frame, run.datum) == ("auv/scene", DATUM)
    assert "origin at 48.0000000° N 4.5000000° W" in repr(run)
    result = reconstruct_run(run, COARSE)
    assert (result.frame, result.datum) == ("auv/scene", DATUM)
    (found,) = result.objects
    assert str(result.place_of(found.dimensions)) in repr(result)


def test_a_run_that_mixes_two_frames_is_refused_by_both_names(tmp_path: Path, tiny_box_bag) -> None:
    made = tiny_box_bag.run
    bag = write_run(tmp_path / "bag", made.image, in_frame(made.track, "map"))
    match = "the track is in frame 'map', the image in 'csas_scene'"
    found = [f for f in check_bag(bag).findings if f.level == "error"]
    assert [match in f.problem for f in found] == [True]
    with pytest.raises(BagError, match=match):
        reconstruct_run(read_run(bag), COARSE)
    with pytest.raises(GeometryError, match="the track is in frame 'map'; expected that of the image"):
        SubApertures(made.image, in_frame(made.track, "map"))


def test_views_in_another_frame_than_their_track_are_refused_by_both_names(
    tmp_path: Path, tiny_box_bag
) -> None:
    made = tiny_box_bag.run
    views = SubApertures(made.image, made.track, COARSE.sub_aperture)
    messages = [
        (f"sub_aperture/{part}", message)
        for aspect in (0.0, 1.0)
        for part, message in zip(
            ("image", "camera_info"),
            view_to_msgs(RosbagsMessages(), views.view_of_aspect(aspect), "sub_aperture"),
            strict=True,
        )
    ]
    bag = write_run(tmp_path / "bag", None, in_frame(made.track, "map"), extra=messages)
    wrong = "the view is in frame 'csas_scene', the track in 'map'"
    assert wrong in {f.problem for f in check_bag(bag).findings if f.level == "error"}
    with pytest.raises(BagError, match="is in frame 'csas_scene'; expected that of the run, 'map'"):
        reconstruct_run(read_run(bag), COARSE)


def test_views_of_another_frame_than_the_run_or_its_target_are_refused(tiny_box_bag) -> None:
    made = tiny_box_bag.run
    target = Target(made.truth.position_m, (1.5, 1.5, 0.8))
    views = SubApertures(made.image, made.track, COARSE.sub_aperture)
    own, other = (views.view_of_aspect(aspect) for aspect in (0.0, 1.0))
    other = replace(other, info=replace(other.info, frame="map"))
    for frame in (None, "csas_scene"):
        decision = Decision(target, frame=frame)
        made_of = Reconstruction(decision, COARSE)
        assert made_of.add(process(own, "sub_aperture", decision, COARSE)[0])
        with pytest.raises(ViewError, match="is in frame 'map'; expected that of the run, 'csas_scene'"):
            made_of.add(process(other, "sub_aperture", decision, COARSE)[0])
    with pytest.raises(ViewError, match="is in frame 'map'; expected that of the target"):
        decision.require_frame(other.info)


def test_poses_of_two_frames_make_two_runs_or_are_refused() -> None:
    angle = np.radians(np.arange(0, 360, 2.0))
    circle = np.c_[30 * np.cos(angle), 30 * np.sin(angle), np.full(180, 12.0)]
    stamps = np.arange(180) * 10**9
    book = TrackBook()
    assert book.add(TrackPiece(stamps[:90], circle[:90])) == 0
    # It would go on from the first, were it in the same frame.
    second = book.add(TrackPiece(stamps[90:], circle[90:], frame="contact_2"))
    assert book.names == (0, second)
    assert (book.track(0).frame, book.track(second).frame) == ("csas_scene", "contact_2")
    with pytest.raises(TrackError, match="is in frame 'contact_2'; expected that of its run, 0 ns"):
        book.add(TrackPiece(stamps[:100], circle[:100], frame="contact_2"))


def test_an_origin_of_another_frame_gives_no_place_and_is_named(tmp_path: Path, tiny_box_bag) -> None:
    made = tiny_box_bag.run
    antenna = origin_to_msg(RosbagsMessages(), Origin(1, "gps", DATUM))
    bag = write_run(tmp_path / "bag", made.image, made.track, extra=[("origin", antenna)])
    run = read_run(bag)
    assert run.datum is None
    assert [p.reason for p in run.problems] == [
        "origin.header.frame_id is 'gps'; expected the run's, 'csas_scene': it gives no place"
    ]
    report = check_bag(bag)
    assert report.ok
    assert [f.level for f in report.findings if f.topic == "/csas/origin"] == ["warning"]


def test_a_heading_that_is_given_turns_the_bags_origin(tmp_path: Path, tiny_box_bag, capsys) -> None:
    made = tiny_box_bag.run
    bag = write_run(tmp_path / "bag", made.image, made.track, datum=DATUM)
    common = ["run", str(bag), "--step-deg", "20", "--voxel-size-m", "0.08", "--no-figures", "--no-bag"]
    assert main([*common, "--out", str(tmp_path / "a"), "--origin-heading-deg", "90"]) == 0
    said = capsys.readouterr().out
    assert "° N 4.5000" in said
    assert "true bearing of its length" in said
    assert main([*common, "--out", str(tmp_path / "b"), "--origin-lat-deg", "10"]) == 1
    assert "origin_lat_deg is given, origin_lon_deg is not; expected both" in capsys.readouterr().err


def test_simulate_writes_the_origin_and_frame_that_it_is_given(tmp_path: Path, capsys) -> None:
    bag = tmp_path / "bag"
    options = ["--origin-lat-deg", "48", "--origin-lon-deg", "-4.5", "--origin-sigma-m", "2"]
    assert main(["simulate", str(bag), "--profile", "tiny", "--scene-frame", "scene_a", *options]) == 0
    run = read_run(bag)
    assert (run.frame, run.datum) == ("scene_a", DATUM)
    capsys.readouterr()
