"""A scene's place on earth as messages, and the frame that every message of a run is in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from csas_shadow_ros.core.geometry import Datum, Origin
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.shape.result import Result
from csas_shadow_ros.core.shape.volume import Target
from msg_adapters import (
    AdapterError,
    coherent_image_from_msgs,
    coherent_image_to_msgs,
    decision_from_msg,
    decision_to_msg,
    measurements_from_msg,
    measurements_to_msg,
    objects_to_msg,
    origin_from_msg,
    origin_to_msg,
    result_to_msgs,
    scene_transform_to_msg,
    sector_from_msgs,
    sector_to_msgs,
    track_from_msg,
    track_to_msg,
    view_from_msgs,
    view_to_msgs,
)

FRAME = "auv_2/contact_7"
DATUM = Datum(48.3829, -4.4953, 30.0, -41.5, (4.0, 2.25, -0.5))
ORIGIN = Origin(1_700_000_000_000_000_007, FRAME, DATUM)


def test_an_origin_comes_back_without_the_heading_that_a_fix_has_no_place_for(factory) -> None:
    read = origin_from_msg(origin_to_msg(factory, ORIGIN))
    assert read == replace(ORIGIN, datum=replace(DATUM, heading_deg=0.0))
    unsure = replace(ORIGIN, datum=Datum(-1.0, 2.0))
    assert origin_from_msg(origin_to_msg(factory, unsure)) == unsure


def test_an_altitude_that_is_not_known_is_taken_as_0(factory) -> None:
    msg = origin_to_msg(factory, ORIGIN)
    msg.altitude = math.nan
    assert origin_from_msg(msg).datum.altitude_m == 0.0


def no_fix(msg) -> None:
    msg.status.status = -1


def south(msg) -> None:
    msg.latitude = -90.5


def nowhere(msg) -> None:
    msg.header.frame_id = ""


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (no_fix, r"origin\.status\.status is -1 \(no fix\); expected a fix"),
        (south, r"origin: latitude of the origin is -90\.5°; expected a number in \[-90, 90\]"),
        (nowhere, r"origin\.header\.frame_id is ''; expected the name"),
    ],
)
def test_what_is_no_origin_is_refused_by_name(factory, spoil, match) -> None:
    msg = origin_to_msg(factory, ORIGIN)
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        origin_from_msg(msg)


def transformed(msg, xyz):
    """What tf2 makes of a point: turned by the quaternion, moved by the translation."""
    q, t = msg.transform.rotation, msg.transform.translation
    u, w, v = np.array([q.x, q.y, q.z]), q.w, np.array(xyz, float)
    turned = 2 * (u @ v) * u + (w * w - u @ u) * v + 2 * w * np.cross(u, v)
    return turned + np.array([t.x, t.y, t.z])


def test_the_transform_leads_from_the_scene_to_the_earths_axes(factory) -> None:
    msg = scene_transform_to_msg(factory, ORIGIN)
    assert (msg.header.frame_id, msg.child_frame_id) == ("earth", FRAME)
    rotation, translation = DATUM.scene_to_earth
    for point in ((0.0, 0.0, 0.0), (10.0, -3.0, 1.0)):
        assert np.allclose(transformed(msg, point), rotation @ point + translation, atol=1e-6)


def test_a_map_at_the_origin_differs_by_the_heading_and_one_elsewhere_by_the_way_there(factory) -> None:
    msg = scene_transform_to_msg(factory, ORIGIN, "map")
    east, north, up = transformed(msg, (0.0, 10.0, 0.5))
    assert (east, north, up) == pytest.approx((5.0, 10 * math.cos(math.radians(30)), 0.5), abs=1e-6)
    far = scene_transform_to_msg(factory, ORIGIN, "map", Datum(48.3829, -4.4953).to_latlon(300.0, -200.0))
    at = transformed(far, (0.0, 0.0, 0.0))
    # The map's tangent plane leans by 1/20 000 against the scene's, 41.5 m over which it lies.
    assert at[:2] == pytest.approx((-300.0, 200.0), abs=0.02)
    assert at[2] == pytest.approx(-41.5, abs=0.02)


def test_a_scene_is_not_its_own_parent(factory) -> None:
    with pytest.raises(AdapterError, match="parent_frame is 'auv_2/contact_7', as the scene's frame"):
        scene_transform_to_msg(factory, ORIGIN, FRAME)


def framed(messages):
    return {m.header.frame_id for m in messages}


def test_what_travels_keeps_its_frame(factory, coherent, sector, views, track) -> None:
    for value, write, read in (
        (replace(coherent, frame=FRAME), coherent_image_to_msgs, coherent_image_from_msgs),
        (replace(sector, frame=FRAME), sector_to_msgs, sector_from_msgs),
    ):
        messages = write(factory, value)
        assert framed(messages) == {FRAME}
        assert read(*messages).frame == FRAME
    view = views["sub_aperture"]
    messages = view_to_msgs(factory, replace(view, info=replace(view.info, frame=FRAME)), "sub_aperture")
    assert framed(messages) == {FRAME}
    assert view_from_msgs(*messages, "sub_aperture").info.frame == FRAME
    track.frame = FRAME
    path = track_to_msg(factory, track)
    assert framed([path, *path.poses]) == {FRAME}
    assert track_from_msg(path).frame == FRAME
    decision = Decision(Target((1.0, 2.0), (1.0, 1.0, 1.0)), frame=FRAME)
    msg = decision_to_msg(factory, decision, 5, None, 5)
    assert framed([msg]) == {FRAME}
    assert decision_from_msg(msg).decision.frame == FRAME


def test_every_message_of_a_result_is_in_its_frame_and_tells_its_datum(factory) -> None:
    result = Result(stamp_ns=5, frame=FRAME, datum=DATUM)
    for name, msg in result_to_msgs(factory, result):
        assert framed(msg.markers if name == "objects" else [msg]) <= {FRAME}, name
    assert objects_to_msg(factory, result).markers == []
    told = measurements_from_msg(measurements_to_msg(factory, result))
    assert (told.frame, told.datum) == (FRAME, DATUM)


def test_an_image_and_a_camera_info_of_two_frames_are_refused_by_both_names(factory, coherent) -> None:
    image, _ = coherent_image_to_msgs(factory, coherent)
    _, info = coherent_image_to_msgs(factory, replace(coherent, frame=FRAME))
    with pytest.raises(
        AdapterError, match=r"camera_info\.header\.frame_id is 'auv_2/contact_7'; expected 'csas_s"
    ):
        coherent_image_from_msgs(image, info)
