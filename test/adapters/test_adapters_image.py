"""Images: what goes in comes out, and whatever breaks the contract is refused by name."""

from __future__ import annotations

import array

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from msg_adapters import (
    STREAMS,
    AdapterError,
    RosbagsMessages,
    image_from_msg,
    image_to_msg,
    pixels_from_msg,
    quantise,
    stamp_to_ns,
)

STAMP_NS = 1_700_000_000_123_456_789
SHAPE = (5, 7)


def sample(stream_name, encoding=None):
    rng = np.random.default_rng(3)
    if stream_name in ("image", "sector", "sub_aperture"):
        pixels = rng.standard_normal(SHAPE) + 1j * rng.standard_normal(SHAPE)
        if encoding in ("8SC2", "16SC2"):
            return quantise(pixels, encoding)
        return pixels.astype(np.complex128 if encoding == "64FC2" else np.complex64)
    if stream_name == "shadow_mask":
        return (rng.random(SHAPE) < 0.5).astype(np.uint8) * 255
    if stream_name == "color_by_aspect":
        return rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    if stream_name == "matter":
        return (rng.random((*SHAPE, 4)) < 0.5).astype(np.uint8) * 255
    if stream_name == "voxel_views":
        return rng.integers(0, 361, (*SHAPE, 4)).astype(np.float32)
    if stream_name == "voxel_grid":
        return rng.random((*SHAPE, 4)).astype(np.float32)
    return rng.random(SHAPE).astype(np.float32)


CASES = [(name, encoding.replace("Cn", "C4")) for name, s in STREAMS.items() for encoding in s.encodings]


@pytest.mark.parametrize(("stream_name", "encoding"), CASES)
def test_pixels_stamp_and_size_survive_the_round_trip(factory, stream_name, encoding):
    pixels = sample(stream_name, encoding)
    msg = image_to_msg(factory, pixels, STAMP_NS, stream_name, encoding)
    assert stamp_to_ns(msg.header.stamp) == STAMP_NS
    assert (msg.height, msg.width, msg.encoding, msg.header.frame_id) == (*SHAPE, encoding, "csas_scene")
    back = image_from_msg(msg, stream_name)
    assert back.dtype == pixels.dtype
    np.testing.assert_array_equal(back, pixels)


def test_rclpy_gets_an_array_and_never_an_ndarray_as_its_bytes():
    pytest.importorskip("rclpy")
    from msg_adapters import RclpyMessages

    msg = image_to_msg(RclpyMessages(), sample("image"), STAMP_NS, "image")
    assert isinstance(msg.data, array.array)
    assert msg.data.typecode == "B"


@pytest.mark.parametrize("encoding", ["32FC2", "64FC2"])
def test_float_pixels_are_views_of_the_message_without_a_copy(factory, encoding):
    msg = image_to_msg(factory, sample("image", encoding), STAMP_NS, "image", encoding)
    assert np.shares_memory(image_from_msg(msg, "image"), np.frombuffer(msg.data, np.uint8))


def test_pixels_from_a_message_cannot_be_written(factory):
    pixels = image_from_msg(image_to_msg(factory, sample("image"), STAMP_NS, "image"), "image")
    with pytest.raises(ValueError, match="read-only"):
        pixels[0, 0] = 0


def with_data(msg, data, **fields):
    """Replace a message's bytes, as its world wants them."""
    raw = bytes(data)
    msg.data = array.array("B", raw) if isinstance(msg.data, array.array) else np.frombuffer(raw, np.uint8)
    for name, value in fields.items():
        setattr(msg, name, value)
    return msg


@pytest.mark.parametrize(
    ("stream_name", "encoding", "swap"),
    [
        ("image", "32FC2", "<f4"),
        ("image", "64FC2", "<f8"),
        ("image", "16SC2", "<i2"),
        ("shadow", "32FC1", "<f4"),
    ],
)
def test_big_endian_pixels_read_the_same(factory, stream_name, encoding, swap):
    pixels = sample(stream_name, encoding)
    msg = image_to_msg(factory, pixels, STAMP_NS, stream_name, encoding)
    with_data(msg, np.frombuffer(bytes(msg.data), swap).byteswap().tobytes(), is_bigendian=1)
    back = image_from_msg(msg, stream_name)
    np.testing.assert_array_equal(back, pixels)
    assert back.dtype.isnative


@pytest.mark.parametrize("padding", [1, 3, 8, 64])
@pytest.mark.parametrize(
    ("stream_name", "encoding"), [("image", "32FC2"), ("image", "8SC2"), ("shadow_mask", "mono8")]
)
def test_padded_rows_read_the_same_as_packed_ones(factory, stream_name, encoding, padding):
    pixels = sample(stream_name, encoding)
    msg = image_to_msg(factory, pixels, STAMP_NS, stream_name, encoding)
    step = msg.step + padding
    padded = np.full((SHAPE[0], step), 0x7F, np.uint8)
    padded[:, : msg.step] = np.frombuffer(bytes(msg.data), np.uint8).reshape(SHAPE[0], -1)
    with_data(msg, padded.tobytes(), step=step)
    np.testing.assert_array_equal(image_from_msg(msg, stream_name), pixels)


def test_memory_that_is_not_aligned_reads_the_same():
    pixels = sample("image")
    msg = image_to_msg(RosbagsMessages(), pixels, STAMP_NS, "image")
    shifted = np.zeros(msg.data.size + 1, np.uint8)
    shifted[1:] = msg.data
    msg.data = shifted[1:]
    back = image_from_msg(msg, "image")
    assert back.flags.aligned
    np.testing.assert_array_equal(back, pixels)


def field(**fields):
    def change(msg):
        for name, value in fields.items():
            setattr(msg, name, value)

    return change


def frame(name):
    def change(msg):
        msg.header.frame_id = name

    return change


def stamp(sec, nanosec):
    def change(msg):
        msg.header.stamp.sec, msg.header.stamp.nanosec = sec, nanosec

    return change


MALFORMED = [
    (field(encoding="32FC1"), r"image\.encoding is '32FC1'; expected one of: 32FC2, 8SC2, 16SC2, 64FC2"),
    (field(encoding="bgr8"), r"image\.encoding is 'bgr8'"),
    (field(encoding=""), r"image\.encoding is ''"),
    (field(width=0), r"image\.width is 0 pixels; expected 1 to 65536"),
    (field(height=0), r"image\.height is 0 pixels"),
    (field(width=70_000), r"image\.width is 70000 pixels"),
    (field(height=4_000_000_000), r"image\.height is 4000000000 pixels"),
    (field(step=55), r"image\.step is 55 bytes; expected 56 \(7 pixels of 32FC2\)"),
    (field(step=0), r"image\.step is 0 bytes"),
    (field(step=57), r"image\.data has 280 bytes; expected step \* height = 57 \* 5 = 285"),
    (field(step=4_000_000_000), r"has 20000000000 bytes; expected at most 4294967295"),
    (field(height=4), r"image\.data has 280 bytes; expected .* = 224"),
    (field(height=6), r"image\.data has 280 bytes; expected .* = 336"),
    (field(width=8), r"image\.step is 56 bytes; expected 64"),
    (field(is_bigendian=2), r"image\.is_bigendian is 2; expected 0 or 1"),
    (lambda m: with_data(m, b""), r"image\.data has 0 bytes; expected .* = 280"),
    (lambda m: with_data(m, bytes(m.data)[:-1]), r"image\.data has 279 bytes"),
    (lambda m: with_data(m, bytes(m.data) + b"\0"), r"image\.data has 281 bytes"),
    (frame(""), r"image\.header\.frame_id is ''"),
    (lambda m: with_data(m, bytes(280)), r"image holds only zeros"),
]


@pytest.mark.parametrize(("spoil", "match"), MALFORMED, ids=[m for _, m in MALFORMED])
def test_a_malformed_image_is_refused_with_field_value_and_expectation(factory, spoil, match):
    msg = image_to_msg(factory, sample("image"), STAMP_NS, "image")
    spoil(msg)
    with pytest.raises(AdapterError, match=match):
        image_from_msg(msg, "image")


@pytest.mark.parametrize(("sec", "nanosec"), [(-1, 0), (0, 1_000_000_000)])
def test_a_stamp_that_is_no_time_is_refused(factory, sec, nanosec):
    msg = image_to_msg(factory, sample("image"), STAMP_NS, "image")
    stamp(sec, nanosec)(msg)
    with pytest.raises(AdapterError, match=rf"header.stamp is {sec} s {nanosec} ns"):
        stamp_to_ns(msg.header.stamp)


def test_another_message_type_is_refused_by_name(factory):
    with pytest.raises(
        AdapterError, match=r"image is a sensor_msgs/msg/CameraInfo; expected sensor_msgs/msg/Image"
    ):
        image_from_msg(factory.make("sensor_msgs/msg/CameraInfo"), "image")
    with pytest.raises(AdapterError, match=r"builtins.dict is not a ROS message"):
        image_from_msg({}, "image")


BAD_PIXELS = [
    ("image", np.nan, r"image has 1 of 35 pixels not finite, the first at row 2, column 3 .*nan"),
    ("sector", complex(0, np.inf), r"sector/image has 1 of 35 pixels not finite"),
    ("sub_aperture", np.inf, r"sub_aperture/image has 1 of 35 pixels infinite.*row 2.*or NaN for no data"),
    ("shadow", np.inf, r"shadow/image has 1 of 35 pixels infinite"),
    ("shadow", -0.5, r"shadow/image has 1 of 35 pixels negative, the first at row 2, column 3 \(-0\.5\)"),
    ("likelihood", 1.001, r"likelihood/image has 1 of 35 pixels outside \[0, 1\].*1\.001"),
    ("likelihood", -0.25, r"likelihood/image has 1 of 35 pixels outside \[0, 1\]"),
    ("likelihood", -np.inf, r"likelihood/image has 1 of 35 pixels infinite"),
    ("shadow_mask", 1, r"shadow_mask/image has 1 of 35 pixels none of 0, 64, 128, 255.*\(1\)"),
    ("voxel_views", -1.0, r"voxel_views/image has 4 of 140 pixels not counts.*row 2, column 3, channel 0"),
    ("voxel_grid", 2.0, r"voxel_grid/image has 4 of 140 pixels outside.*row 2, column 3, channel 0"),
]


@pytest.mark.parametrize(("stream_name", "value", "match"), BAD_PIXELS)
def test_bad_pixels_are_counted_and_the_first_is_placed(factory, stream_name, value, match):
    good = sample(stream_name)
    msg = image_to_msg(factory, good, STAMP_NS, stream_name)
    bad = good.copy()
    bad[2, 3] = value
    with_data(msg, bad.tobytes())
    with pytest.raises(AdapterError, match=match):
        image_from_msg(msg, stream_name)
    with pytest.raises(AdapterError, match=match):
        image_to_msg(factory, bad, STAMP_NS, stream_name)


@pytest.mark.parametrize("stream_name", ["sub_aperture", "shadow", "likelihood", "voxel_grid"])
def test_nan_means_no_data_where_a_view_may_know_nothing(factory, stream_name):
    pixels = sample(stream_name)
    pixels[1] = np.nan
    back = image_from_msg(image_to_msg(factory, pixels, STAMP_NS, stream_name), stream_name)
    np.testing.assert_array_equal(back, pixels)


@pytest.mark.parametrize("stream_name", ["sub_aperture", "shadow", "likelihood"])
def test_a_view_that_knows_nothing_at_all_is_refused(factory, stream_name):
    pixels = np.full_like(sample(stream_name), np.nan)
    with pytest.raises(AdapterError, match="holds only NaN"):
        image_to_msg(factory, pixels, STAMP_NS, stream_name)


@pytest.mark.parametrize("stream_name", ["image", "sector", "sub_aperture", "shadow", "multilook"])
def test_an_image_of_zeros_is_refused(factory, stream_name):
    with pytest.raises(AdapterError, match="holds only zeros"):
        image_to_msg(factory, np.zeros_like(sample(stream_name)), STAMP_NS, stream_name)


@pytest.mark.parametrize("stream_name", ["likelihood", "shadow_mask", "voxel_grid"])
def test_zeros_are_an_answer_where_they_can_be_true(factory, stream_name):
    pixels = np.zeros_like(sample(stream_name))
    back = image_from_msg(image_to_msg(factory, pixels, STAMP_NS, stream_name), stream_name)
    np.testing.assert_array_equal(back, pixels)


def test_arrays_that_do_not_fit_the_encoding_are_refused(factory):
    complex_pixels, real = sample("image"), sample("shadow")
    with pytest.raises(AdapterError, match=r"shape \(5, 7, 1\); expected \(rows, cols\) for 32FC2"):
        image_to_msg(factory, complex_pixels[..., None], STAMP_NS, "image")
    with pytest.raises(AdapterError, match=r"holds float32; expected complex numbers for 32FC2"):
        image_to_msg(factory, real, STAMP_NS, "image")
    with pytest.raises(AdapterError, match=r"holds float32; expected uint8 for mono8"):
        image_to_msg(factory, np.zeros(SHAPE, np.float32), STAMP_NS, "shadow_mask")
    with pytest.raises(AdapterError, match=r"encoding is '64FC2'; expected one of: 32FC2"):
        image_to_msg(factory, complex_pixels, STAMP_NS, "sub_aperture", "64FC2")
    with pytest.raises(AdapterError, match=r"no image stream 'sidescan'; expected one of: image"):
        image_to_msg(factory, complex_pixels, STAMP_NS, "sidescan")
    with pytest.raises(AdapterError, match=r"stamp is -1 ns"):
        image_to_msg(factory, complex_pixels, -1, "image")
    with pytest.raises(AdapterError, match=r"stamp is 2147483648000000000 ns"):
        image_to_msg(factory, complex_pixels, (1 << 31) * 10**9, "image")


def test_integers_are_never_rounded_or_clipped_silently(factory):
    with pytest.raises(AdapterError, match="has fractions; expected whole numbers for 8SC2"):
        image_to_msg(factory, np.full(SHAPE, 1.5 + 0j), STAMP_NS, "image", "8SC2")
    with pytest.raises(AdapterError, match="has a value of 128; expected at most 127 for 8SC2"):
        image_to_msg(factory, np.full(SHAPE, 1 - 128j), STAMP_NS, "image", "8SC2")


@pytest.mark.parametrize(("encoding", "limit"), [("8SC2", 127), ("16SC2", 32767)])
def test_quantising_fills_the_range_and_errs_by_half_a_step_at_most(encoding, limit):
    pixels = sample("image", "64FC2")
    whole = quantise(pixels, encoding)
    parts = np.concatenate([whole.real, whole.imag])
    assert np.abs(parts).max() == limit
    scale = limit / max(np.abs(pixels.real).max(), np.abs(pixels.imag).max())
    assert np.abs(whole - pixels * scale).max() <= np.sqrt(0.5) * (1 + 1e-4)


@given(
    pixels=hnp.arrays(
        np.complex64,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=6),
        elements=st.complex_numbers(max_magnitude=1e6, allow_nan=False, allow_infinity=False, width=64),
    ),
    encoding=st.sampled_from(["32FC2", "64FC2"]),
    stamp_ns=st.integers(0, (1 << 31) * 10**9 - 1),
)
def test_any_finite_image_survives_or_holds_only_zeros(pixels, encoding, stamp_ns):
    if not pixels.any():
        with pytest.raises(AdapterError, match="only zeros"):
            image_to_msg(RosbagsMessages(), pixels, stamp_ns, "image", encoding)
        return
    msg = image_to_msg(RosbagsMessages(), pixels, stamp_ns, "image", encoding)
    np.testing.assert_array_equal(image_from_msg(msg, "image"), pixels)
    assert stamp_to_ns(msg.header.stamp) == stamp_ns


@given(
    height=st.integers(0, 2**32 - 1),
    width=st.integers(0, 2**32 - 1),
    step=st.integers(0, 2**32 - 1),
    big=st.integers(0, 3),
    encoding=st.sampled_from(["32FC2", "8SC2", "mono8", "", "32FC"]),
    data=st.binary(max_size=64),
)
def test_any_header_over_any_bytes_reads_or_is_refused_but_never_fails_otherwise(
    height, width, step, big, encoding, data
):
    msg = RosbagsMessages().make(
        "sensor_msgs/msg/Image",
        height=height,
        width=width,
        step=step,
        is_bigendian=big,
        encoding=encoding,
        data=np.frombuffer(data, np.uint8),
    )
    try:
        pixels = pixels_from_msg(msg, ("32FC2", "8SC2"))
    except AdapterError:
        return
    assert pixels.shape == (height, width)
    assert pixels.dtype == np.complex64


def test_an_image_that_no_message_can_hold_is_refused_before_it_is_copied(factory):
    vast = np.broadcast_to(np.uint8(7), (1 << 16, 1 << 15, 3))
    with pytest.raises(AdapterError, match=r"color_by_aspect/image .* has 6442450944 bytes; expected"):
        image_to_msg(factory, vast, 1, "color_by_aspect")
