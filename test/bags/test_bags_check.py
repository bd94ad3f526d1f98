"""Checking a bag: a sound one passes, and each fault is found, placed and given a remedy."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csas_shadow_ros.bags import BagWriter, check_bag, read_run, write_run
from csas_shadow_ros.bags.check import (
    band_energy,
    check_spectrum_sign,
    judge_band,
    judge_coverage,
    judge_energy,
    judge_geometry,
    judge_image,
    judge_stuck,
)
from csas_shadow_ros.core.errors import BagError, ParameterError, ViewError
from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.parameters import SubApertureParameters
from csas_shadow_ros.core.search.bodies import LEAVES, Search, SignEvidence
from csas_shadow_ros.core.shape.result import OTHER_SIGN, LeftOut
from csas_shadow_ros.run_bag import refuse_contradictions
from msg_adapters import RosbagsMessages, coherent_image_to_msgs, track_to_msg, view_to_msgs

START_NS = 1_700_000_000_000_000_000
ACOUSTICS = Acoustics(120e3, 40e3, 1500.0, -1)
FACTORY = RosbagsMessages()
SPACING_M = 0.0025
SIDE = 128


def circle(n=360, arc=2 * np.pi, radius=75.0, height=18.0):
    aspects = np.arange(n) * arc / n
    positions = np.column_stack([radius * np.cos(aspects), radius * np.sin(aspects), np.full(n, height)])
    return Track(START_NS + np.arange(n) * 1_000_000_000, positions)


def annulus_image(acoustics=ACOUSTICS, spacing=SPACING_M, seed=0):
    """Noise whose spectrum fills the band's annulus, as circular SAS leaves it."""
    grid = GroundGrid.centred(SIDE, SIDE, spacing)
    k = 2 * np.pi * np.fft.fftfreq(SIDE, SPACING_M)
    low, _, high = ACOUSTICS.ground_band(math.atan2(18, 75))
    radius = np.hypot(k[:, None], k[None, :])
    rng = np.random.default_rng(seed)
    spectrum = rng.standard_normal((SIDE, SIDE)) + 1j * rng.standard_normal((SIDE, SIDE))
    spectrum[(radius < low) | (radius > high)] = 0
    return CoherentImage(np.fft.ifft2(spectrum).astype(np.complex64), grid, acoustics, START_NS)


@pytest.fixture(autouse=True)
def no_search(request, monkeypatch):
    """Leave out the search for shadows, which these images have none of."""
    if "sign" not in request.node.name:
        monkeypatch.setattr("csas_shadow_ros.bags.check.check_spectrum_sign", lambda image, track: ())


def only(report, level="error"):
    (finding,) = [f for f in report.findings if f.level == level]
    return finding


def test_a_sound_run_passes_without_a_word_of_blame(tmp_path):
    report = check_bag(write_run(tmp_path / "run", annulus_image(), circle()))
    assert report.ok
    assert {f.level for f in report.findings} == {"info"}
    assert report.usable == {"track": 360, "image": 1}
    assert report.topics == {"/csas/image": 1, "/csas/camera_info": 1, "/csas/track": 1}
    assert "processing can start from image and track" in str(report)


def test_the_report_is_json(tmp_path):
    report = check_bag(write_run(tmp_path / "run", annulus_image(), None))
    data = json.loads(report.to_json())
    assert data["ok"] is False
    assert data["findings"][0]["level"] == "error"
    assert set(data["findings"][0]) == {"level", "topic", "number", "stamp_ns", "problem", "remedy"}


@pytest.mark.parametrize("encoding", ["8SC2", "16SC2", "32FC2", "64FC2"])
def test_every_encoding_passes(tmp_path, encoding):
    assert check_bag(write_run(tmp_path / "run", annulus_image(), circle(), encoding=encoding)).ok


def test_what_is_no_bag_is_an_error_and_not_an_exception(tmp_path):
    finding = only(check_bag(tmp_path / "nothing"))
    assert "there is no bag at" in finding.problem
    assert finding.remedy


def test_an_empty_bag_has_nothing_to_start_from(tmp_path):
    BagWriter(tmp_path / "run").close()
    report = check_bag(tmp_path / "run")
    text = str(report)
    assert not report.ok
    assert "the bag holds no messages" in text
    assert "nothing to start from" in text
    assert "Record /csas/image, /csas/camera_info, /csas/track" in text


def test_an_image_without_a_track_is_not_enough(tmp_path):
    finding = only(check_bag(write_run(tmp_path / "run", annulus_image(), None)))
    assert finding.topic == "/csas/track"
    assert "no usable track" in finding.problem
    assert "Record /csas/track (nav_msgs/Path)" in finding.remedy


def write(path, *messages):
    with BagWriter(path) as writer:
        for topic, msg in messages:
            writer.write(topic, msg, START_NS)
    return path


def run_messages(image=None, track=None):
    a, b = coherent_image_to_msgs(FACTORY, image or annulus_image())
    return a, b, track_to_msg(FACTORY, track or circle())


def spoil_step(a, b, c):
    a.step = 3


def spoil_nan(a, b, c):
    a.data = a.data.copy()
    a.data[:4] = np.frombuffer(np.float32(np.nan).tobytes(), np.uint8)


def spoil_zero(a, b, c):
    a.data = np.zeros_like(a.data)


def spoil_encoding(a, b, c):
    a.encoding = "32FC1"


def spoil_model(a, b, c):
    b.distortion_model = "plumb_bob"


def spoil_sign(a, b, c):
    b.d = np.array([120e3, 40e3, 1500.0, 0.0])


def spoil_stamp(a, b, c):
    b.header.stamp.sec += 1


def spoil_size(a, b, c):
    b.width += 1


def spoil_frame(a, b, c):
    c.header.frame_id = "map"


def spoil_order(a, b, c):
    c.poses = c.poses[::-1]


def spoil_depth(a, b, c):
    for pose in c.poses:
        pose.pose.position.z = -18.0


@pytest.mark.parametrize(
    ("spoil", "topic", "problem", "remedy"),
    [
        (spoil_step, "/csas/image", "image.step is 3 bytes; expected 1024", "publisher of /csas/image"),
        (spoil_nan, "/csas/image", "1 of 16384 pixels not finite, the first at row 0, column 0", "publisher"),
        (spoil_zero, "/csas/image", "holds only zeros", "publisher"),
        (spoil_encoding, "/csas/image", "encoding is '32FC1'", "publisher"),
        (spoil_model, "/csas/image", "distortion_model is 'plumb_bob'", "publisher"),
        (spoil_sign, "/csas/image", "spectrum_sign, is 0; expected +1 or -1", "publisher"),
        (spoil_stamp, "/csas/image", "has no camera_info of the same stamp", "the very same header.stamp"),
        (spoil_size, "/csas/image", "camera_info.width is 129; expected", "publisher"),
        (spoil_frame, "/csas/track", "poses[0].header.frame_id is 'csas_scene'; expected 'map'", "publisher"),
        (spoil_order, "/csas/track", "out of order: pose 0 ", "publisher of /csas/track"),
        (spoil_depth, "/csas/track", "pose 0 is at z = -18 m", "publisher of /csas/track"),
    ],
)
def test_each_fault_is_placed_and_has_a_remedy(tmp_path, spoil, topic, problem, remedy):
    a, b, c = run_messages()
    spoil(a, b, c)
    path = write(tmp_path / "run", ("/csas/image", a), ("/csas/camera_info", b), ("/csas/track", c))
    report = check_bag(path)
    assert not report.ok
    found = [f for f in report.findings if f.level == "error" and problem in f.problem]
    assert len(found) == 1
    assert (found[0].topic, found[0].number) == (topic, 0)
    assert found[0].stamp_ns is not None
    assert remedy in found[0].remedy


def test_a_view_that_a_recorder_lost_half_of_is_no_error_where_nothing_needs_it(tmp_path):
    """As ros2 bag record leaves it on a busy machine: it reads no reports."""
    a, b, c = run_messages()
    image, _ = view_to_msgs(FACTORY, view(10), "shadow")
    run = [("/csas/image", a), ("/csas/camera_info", b), ("/csas/track", c)]
    lost = [("/csas/shadow/image", image)]

    whole, views = check_bag(write(tmp_path / "whole", *run, *lost)), check_bag(write(tmp_path / "v", *lost))

    assert whole.ok
    (told,) = [f for f in whole.findings if "has no camera_info of the same stamp" in f.problem]
    assert (told.level, told.topic) == ("warning", "/csas/shadow/image")
    assert "has no camera_info of the same stamp" in only_of(views, "/csas/shadow/image").problem


def only_of(report, topic):
    (finding,) = [f for f in report.findings if f.level == "error" and f.topic == topic]
    return finding


def test_topics_of_other_objects_and_of_the_other_method_are_of_the_contract(tmp_path):
    a, b, c = run_messages()
    image, info = view_to_msgs(FACTORY, view(10), "shadow")
    more = [("/csas/other_method/voxel_grid/image", image), ("/csas/object_2/voxel_grid/camera_info", info)]
    path = write(
        tmp_path / "run",
        *(("/csas/image", a), ("/csas/camera_info", b), ("/csas/track", c)),
        *more,
        ("/csas/own/image", image),
    )

    (told,) = [f for f in check_bag(path).findings if "not part of the contract" in f.problem]

    assert told.problem == "1 topics are not part of the contract: /csas/own/image"


def test_a_topic_of_another_type_is_named_with_the_right_one(tmp_path):
    a, b, _ = run_messages()
    wrong = FACTORY.make("geometry_msgs/msg/PoseStamped")
    report = check_bag(
        write(tmp_path / "run", ("/csas/image", a), ("/csas/camera_info", b), ("/csas/track", wrong))
    )
    (finding,) = [f for f in report.findings if "its type is" in f.problem]
    assert "'geometry_msgs/msg/PoseStamped'; expected nav_msgs/msg/Path" in finding.problem
    assert finding.remedy == "Publish /csas/track as nav_msgs/msg/Path."


def test_a_track_with_a_gap_is_usable_with_a_warning(tmp_path):
    report = check_bag(write_run(tmp_path / "run", annulus_image(), circle(300, np.radians(300))))
    assert report.ok
    finding = only(report, "warning")
    assert "covers 299.0 of 360 degrees; missing: 299.0° to 360.0°" in finding.problem


def test_a_damaged_bag_is_not_ok_even_if_it_can_be_read(tmp_path):
    path = write_run(tmp_path / "run", annulus_image(), circle())
    (path / "metadata.yaml").unlink()
    assert "metadata.yaml is missing" in only(check_bag(path)).problem


def view(degrees, sonar_range=75.0):
    aspect = math.radians(degrees)
    sonar = (sonar_range * math.cos(aspect), sonar_range * math.sin(aspect), 18.0 * sonar_range / 75.0)
    camera = ShadowCamera.from_ground(view_ground_to_pixel(aspect, 0.02, 8, 9, (0, 0)), sonar, 8, 9)
    info = ViewInfo(START_NS + degrees * 1_000_000_000, camera, ACOUSTICS, aspect, math.radians(12))
    return View(info, np.random.default_rng(degrees).random((8, 9)).astype(np.float32))


def test_a_later_stage_alone_is_enough_to_start_from(tmp_path):
    extra = []
    for d in (0, 10, 20):
        a, b = view_to_msgs(FACTORY, view(d), "likelihood")
        extra += [("likelihood/image", a), ("likelihood/camera_info", b)]
    report = check_bag(write_run(tmp_path / "run", None, None, extra=extra))
    assert report.ok
    assert "processing can start from likelihood (3 views)" in str(report)


def test_a_view_whose_sonar_is_off_the_track_is_a_warning(tmp_path):
    good, bad = view_to_msgs(FACTORY, view(5), "shadow"), view_to_msgs(FACTORY, view(10, 60.0), "shadow")
    extra = [
        (t, m)
        for pair in (good, bad)
        for t, m in zip(("shadow/image", "shadow/camera_info"), pair, strict=True)
    ]
    finding = only(check_bag(write_run(tmp_path / "run", None, circle(), extra=extra)), "warning")
    assert finding.number == 1
    assert "15.43 m from the track at that stamp" in finding.problem


def test_a_view_outside_the_tracks_time_is_a_warning(tmp_path):
    late = view(10)
    late = View(replace(late.info, stamp_ns=START_NS + 10**13), late.pixels)
    a, b = view_to_msgs(FACTORY, late, "shadow")
    report = check_bag(
        write_run(tmp_path / "run", None, circle(), extra=[("shadow/image", a), ("shadow/camera_info", b)])
    )
    assert "outside the track's time" in only(report, "warning").problem


# --- band and geometry


def levels(findings):
    return [level for level, _, _ in findings]


def test_an_image_holds_all_its_energy_in_its_stated_band():
    energy = band_energy(annulus_image(), circle().grazing_rad)
    low, _, high = ACOUSTICS.ground_band(circle().grazing_rad)
    assert energy.fraction > 0.999
    assert 0.95 * low < energy.low_rad_m < energy.high_rad_m < 1.05 * high
    assert levels(judge_energy(annulus_image(), circle())) == []


@pytest.mark.parametrize(
    "wrong",
    [
        {"acoustics": Acoustics(60e3, 20e3, 1500.0, -1)},
        {"acoustics": Acoustics(120e3, 40e3, 5000.0, -1)},
        {"spacing": 0.005},
    ],
    ids=["frequency", "sound speed", "pixel spacing"],
)
def test_a_wrong_frequency_sound_speed_or_spacing_is_found(wrong):
    ((level, problem, remedy),) = judge_energy(annulus_image(**wrong), circle())
    assert level == "error"
    assert "of the image's energy lies in its stated band" in problem
    assert "check centre frequency, bandwidth and sound speed" in remedy


def test_the_remedy_names_the_frequencies_where_the_energy_is():
    wrong = annulus_image(acoustics=Acoustics(60e3, 20e3, 1500.0, -1))
    _, _, remedy = next(iter(judge_energy(wrong, circle())))
    low, high = (float(x) for x in remedy.split("that is ")[1].split(" Hz")[0].split(" to "))
    assert 98e3 < low < 108e3
    assert 132e3 < high < 142e3


@settings(max_examples=50)
@given(factor=st.floats(0.2, 5.0), height=st.floats(1, 100))
def test_a_band_that_the_pixels_cannot_hold_is_an_error(factor, height):
    track = circle(height=height)
    high = ACOUSTICS.ground_band(track.grazing_rad)[2]
    grid = GroundGrid.centred(64, 64, math.pi / high * factor)
    if abs(factor - 1) > 1e-8:
        assert levels(judge_band(grid, ACOUSTICS, track)) == ([] if factor < 1 else ["error"])


@pytest.mark.parametrize("finer", [1.03, 0.97, 0.5])
def test_check_calls_too_coarse_what_the_method_refuses_and_nothing_else(finer):
    """A band 3 % beyond the pixels was a warning here, and an error of the method."""
    image, track = annulus_image(), circle()
    high = image.acoustics.ground_band(track.grazing_rad)[2]
    coarse = replace(image, grid=replace(image.grid, spacing_m=math.pi / high / finer))
    found = [problem for level, problem, _ in judge_image(coarse, track) if level == "error"]
    if finer > 1.0:
        SubApertures(coarse, track, SubApertureParameters())
        assert not any("pixel of at most" in problem for problem in found)
        return
    with pytest.raises(ParameterError) as refused:
        SubApertures(coarse, track, SubApertureParameters())
    assert found == [str(refused.value)]
    assert "expected a pixel of at most" in found[0]
    assert [*check_spectrum_sign(coarse, track)] == []


def test_an_image_of_zeros_is_one_error():
    """It was told that "nan %" of its energy lies in its band."""
    image = annulus_image()
    blank = replace(image, pixels=np.zeros_like(image.pixels))
    ((level, problem, _),) = judge_image(blank, circle())
    assert (level, problem) == ("error", "the image holds only zeros")


def test_amplitudes_are_not_taken_for_a_wrong_height():
    image = annulus_image()
    ((level, problem, remedy),) = judge_energy(replace(image, pixels=np.abs(image.pixels) + 0j), circle())
    assert level == "error"
    assert "above the seabed" not in problem
    assert "with their phase, not amplitudes, and not at baseband" in remedy


def test_a_track_of_too_few_poses_names_how_far_apart_they_are():
    ((level, problem, remedy),) = judge_coverage(circle(72))
    assert level == "error"
    assert problem.endswith("no view can be made; its poses lie 5.0° of aspect apart (median of 71 steps)")
    assert "at most 3 degrees apart" in remedy
    # Angles in degrees that were put into cos and sin.
    aspects = np.arange(360.0)
    positions_m = np.column_stack([75 * np.cos(aspects), 75 * np.sin(aspects), np.full(360, 18.0)])
    mixed = Track(circle().stamps_ns, positions_m)
    ((_, problem, _),) = judge_coverage(mixed)
    assert "its poses lie 57.3° of aspect apart" in problem


def test_a_circle_that_no_sonar_flies_is_told():
    grid = GroundGrid.centred(64, 64, 0.002)
    ((level, problem, _),) = judge_geometry(grid, circle(radius=75_000.0, height=18_000.0))
    assert level == "warning"
    assert "radius of 75000 m" in problem
    assert [*judge_geometry(grid, circle())] == []


def test_a_gap_ends_within_the_circle():
    cut = Track(circle().stamps_ns[10:350], circle().positions_m[10:350])
    assert [str(gap) for gap in cut.gaps] == ["349.0° to 10.0°"]


def test_a_track_over_the_image_or_beside_it_is_an_error():
    grid = GroundGrid.centred(100, 100, 0.1)
    assert levels(judge_geometry(grid, circle())) == []
    ((level, problem, _),) = judge_geometry(grid, circle(radius=4.0))
    assert (level, "track pose 0 at (4.00, 0.00) m is over the image" in problem) == ("error", True)
    ((level, problem, _),) = judge_geometry(GroundGrid.centred(100, 100, 0.1, (200.0, 0.0)), circle())
    assert (level, "200.0 m from the centre of the track's circle (radius 75.0)" in problem) == (
        "error",
        True,
    )


# --- spectrum sign


@pytest.mark.parametrize(
    ("evidence", "level", "text"),
    [
        (SignEvidence(-1, 100.0, 0.0), "info", "spectrum_sign is -1: shadows fall away from the sonar"),
        (SignEvidence(-1, 0.0, 100.0), "error", "shadows fall towards the sonar"),
        (SignEvidence(-1, 0.0, 0.0), "info", "no shadows to tell by"),
    ],
)
def test_evidence_for_the_spectrum_sign_becomes_a_finding(monkeypatch, evidence, level, text):
    asked = "csas_shadow_ros.core.search.bodies.spectrum_sign_evidence"
    monkeypatch.setattr(asked, lambda i, t: (evidence, None))
    ((found, problem, remedy),) = check_spectrum_sign(annulus_image(), circle())
    assert found == level
    assert text in problem
    assert (remedy == "Set spectrum_sign (camera_info.d[3]) to +1.") == (level == "error")


def test_a_spectrum_sign_that_cannot_be_checked_is_a_warning(monkeypatch):
    def fail(image, track):
        raise ViewError("no aspect is covered")

    monkeypatch.setattr("csas_shadow_ros.core.search.bodies.spectrum_sign_evidence", fail)
    ((level, problem, _),) = check_spectrum_sign(annulus_image(), circle())
    assert (level, problem) == ("warning", "the spectrum sign cannot be checked: no aspect is covered")


@pytest.mark.parametrize(
    ("reason", "remedy"),
    [
        (LEAVES, "Process a larger scene: a body with its shadows off the image cannot be judged."),
        (f"{OTHER_SIGN} a faint body throws a shadow here", "Check spectrum_sign (camera_info.d[3])."),
    ],
)
def test_check_of_the_sign_warns_of_what_a_run_would_leave_undecided(monkeypatch, reason, remedy):
    search = Search((), None, None, (LeftOut((1.0, -0.001), reason), LeftOut((0.0, 0.0), "it is too low")))
    asked = "csas_shadow_ros.core.search.bodies.spectrum_sign_evidence"
    monkeypatch.setattr(asked, lambda i, t: (SignEvidence(-1, 0.0, 0.0), search))
    _, *warned = check_spectrum_sign(annulus_image(), circle())
    assert warned == [("warning", f"something stands at (1.00, 0.00) m: {reason}", remedy)]


def test_the_spectrum_sign_is_checked_with_the_method_itself(tmp_path):
    report = check_bag(write_run(tmp_path / "run", annulus_image(), circle()))
    assert any("spectrum sign" in f.problem or "spectrum_sign" in f.problem for f in report.findings)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_frequency_ten_per_cent_off_is_a_warning_that_names_the_right_one(factor):
    # Wide bands overlap even then: only where the energy is centred shows it.
    stated = annulus_image(Acoustics(120e3 * factor, 40e3, 1500.0, -1))
    ((level, problem, remedy),) = judge_energy(stated, circle())
    assert level == "warning"
    assert "from the stated band's" in problem
    named = float(remedy.split("centre frequency ")[1].split(" Hz")[0])
    assert named == pytest.approx(120e3, rel=0.02)


def test_a_track_that_leaves_room_for_no_view_is_an_error(tmp_path):
    sparse = circle()
    sparse = Track(sparse.stamps_ns[::10], sparse.positions_m[::10])
    report = check_bag(write_run(tmp_path / "run", annulus_image(), sparse))
    assert not report.ok
    finding = only(report)
    assert "no view can be made" in finding.problem
    assert "at most 3 degrees apart" in finding.remedy


def test_what_is_wrong_with_many_messages_alike_is_told_once_and_each_is_in_the_json(tmp_path):
    extra = []
    for i in range(5):
        a, b = view_to_msgs(FACTORY, view(i), "shadow")
        b.distortion_model = "plumb_bob"
        extra += [("shadow/image", a), ("shadow/camera_info", b)]
    report = check_bag(write_run(tmp_path / "run", None, circle(), extra=extra))
    assert str(report).count("plumb_bob") == 1
    assert "(5 messages alike)" in str(report)
    assert sum("plumb_bob" in f["problem"] for f in report.as_dict()["findings"]) == 5


def test_a_view_filled_with_zeros_off_the_image_is_a_warning_and_one_with_nan_is_none(tmp_path):
    def checked(name, outside):
        pixels = np.array(view(3).pixels)
        pixels[:2] = outside
        a, b = view_to_msgs(FACTORY, View(view(3).info, pixels), "shadow")
        extra = [("shadow/image", a), ("shadow/camera_info", b)]
        return check_bag(write_run(tmp_path / name, None, circle(), extra=extra))

    assert "exactly 0, out to a corner" in only(checked("zeros", 0.0), "warning").problem
    assert not [f for f in checked("nan", np.nan).findings if f.level == "warning"]


def test_a_second_image_is_a_warning(tmp_path):
    second = replace(annulus_image(), stamp_ns=annulus_image().stamp_ns + 1)
    a, b = coherent_image_to_msgs(FACTORY, second)
    bag = write_run(tmp_path / "run", annulus_image(), circle(), extra=[("image", a), ("camera_info", b)])
    finding = next(f for f in check_bag(bag).findings if f.level == "warning")
    assert "second image" in finding.problem


def with_pixels(level_db, *places):
    """Return a sound image with single pixels of a level over its median."""
    image = annulus_image()
    pixels = image.pixels.copy()
    for place in places:
        pixels[place] = np.median(np.abs(pixels)) * 10 ** (level_db / 20)
    return replace(image, pixels=pixels)


@pytest.mark.parametrize("place", [(0, 0), (40, 100), (SIDE - 1, SIDE - 1)], ids=str)
@pytest.mark.parametrize(("level_db", "level"), [(42.0, "warning"), (60.0, "error"), (80.0, "error")])
def test_a_stuck_pixel_is_named_with_its_level_and_refused_where_it_costs_the_shape(place, level_db, level):
    ((found, problem, remedy),) = judge_stuck(with_pixels(level_db, place))
    assert found == level
    assert f"the pixel in row {place[0]}, column {place[1]} is {level_db:.0f} dB over the median" in problem
    assert ("it is used as it is" in problem) == (level == "warning")
    assert "Set it to 0" in remedy


@pytest.mark.parametrize("amplitude", [1e-30, 1e-20, 1e18, 1e25, 1e34])
def test_a_stuck_pixel_is_found_and_no_other_whatever_the_amplitude(amplitude):
    """Squares of these are beyond what float32 holds."""
    image = with_pixels(60.0, (5, 7))
    scale = np.float32(amplitude)
    assert levels(judge_stuck(replace(annulus_image(), pixels=annulus_image().pixels * scale))) == []
    ((_, problem, _),) = judge_stuck(replace(image, pixels=image.pixels * scale))
    assert "row 5, column 7 is 60 dB over the median" in problem


def test_several_stuck_pixels_are_counted():
    ((_, problem, _),) = judge_stuck(with_pixels(70.0, (3, 4), (60, 60), (100, 2)))
    assert "(and 2 more like it)" in problem


@settings(max_examples=40, deadline=None)
@given(st.floats(20.0, SIDE - 20.0), st.floats(20.0, SIDE - 20.0), st.floats(30.0, 80.0))
def test_a_bright_point_anywhere_between_the_pixels_is_no_stuck_pixel(row, col, level_db):
    image = annulus_image()
    k = 2 * np.pi * np.fft.fftfreq(SIDE)
    low, _, high = (SPACING_M * edge for edge in ACOUSTICS.ground_band(math.atan2(18, 75)))
    radius = np.hypot(k[:, None], k[None, :])
    band = (radius >= low) & (radius <= high)
    point = np.fft.ifft2(np.where(band, np.exp(-1j * (k[:, None] * row + k[None, :] * col)), 0))
    point *= np.median(np.abs(image.pixels)) * 10 ** (level_db / 20) / np.abs(point).max()
    assert levels(judge_stuck(replace(image, pixels=(image.pixels + point).astype(np.complex64)))) == []


def test_run_refuses_an_image_with_a_stuck_pixel_and_reports_a_lesser_one(tmp_path):
    for level_db, refused in ((60.0, True), (42.0, False)):
        path = write_run(tmp_path / f"{level_db:.0f}", with_pixels(level_db, (40, 100)), circle())
        found = read_run(path)
        told: list[str] = []
        if refused:
            with pytest.raises(BagError, match=r"pixel in row 40, column 100 is 60 dB over the median"):
                refuse_contradictions(found.image, found.track, told.append, found)
            continue
        refuse_contradictions(found.image, found.track, told.append, found)
        assert "row 40, column 100 is 42 dB" in told[0]
        assert "row 40, column 100 is 42 dB" in str(found.problems[0])


@pytest.mark.parametrize("count", [1, 7, 8])
def test_poses_without_a_fix_are_left_out_with_how_many_until_they_are_too_many(tmp_path, count):
    image, info, path = run_messages(track=circle(720))
    for one in path.poses[300 : 300 + count]:
        one.pose.position.x = math.nan
    bag = write(tmp_path / "bag", ("/csas/image", image), ("/csas/camera_info", info), ("/csas/track", path))
    report = check_bag(bag)
    told = [
        f.problem for f in report.findings if "finite metres" in f.problem or "more track poses" in f.problem
    ]
    if count > 7:  # 1 % of 720
        assert not report.ok
        assert "(8 of 720 poses cannot be used)" in told[0]
        return
    assert report.ok
    assert report.usable["track"] == 720 - count
    assert len(told) == min(count, 4)
    assert [str(p.reason) for p in read_run(bag).problems] == told
    if count > 3:
        assert told[-1] == "4 more track poses cannot be used: left out"
