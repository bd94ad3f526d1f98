"""sensor_msgs/Image to and from arrays."""

from __future__ import annotations

import math
import re
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError, quoted
from csas_shadow_ros.core.imaging.mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN

from .messages import MessageFactory, check_type, frame_of, make_header
from .topics import IMAGE, MATTER_ENCODING, VOXEL_ENCODING, ImageStream, stream

MAX_SIDE = 1 << 16
MAX_BYTES = (1 << 32) - 1  # the length of a ROS sequence is a uint32

#: encoding: (scalar, channels, complex)
_FIXED: dict[str, tuple[str, int, bool]] = {
    "8SC2": ("i1", 2, True),
    "16SC2": ("i2", 2, True),
    "32FC2": ("f4", 2, True),
    "64FC2": ("f8", 2, True),
    "32FC1": ("f4", 1, False),
    "mono8": ("u1", 1, False),
    "rgb8": ("u1", 3, False),
}


#: Scalars of the encodings whose channels are heights.
_VOXEL_SCALARS = {VOXEL_ENCODING: "f4", MATTER_ENCODING: "u1"}


def _is_voxels(encodings: tuple[str, ...]) -> bool:
    return not _VOXEL_SCALARS.keys().isdisjoint(encodings)


def _layout(encoding: str, allowed: tuple[str, ...], where: str) -> tuple[str, int, bool]:
    if _is_voxels(allowed):
        # A channel a height: 32FC3 of 32FCn.
        for kind in allowed:
            match = re.fullmatch(kind[:-1] + r"([1-9]\d{0,4})", encoding)
            if match:
                return _VOXEL_SCALARS[kind], int(match.group(1)), False
    elif encoding in allowed and encoding in _FIXED:
        return _FIXED[encoding]
    raise AdapterError(f"{where}.encoding is {quoted(encoding)}; expected one of: {', '.join(allowed)}")


def pixels_from_msg(msg: Any, encodings: tuple[str, ...], where: str = "image") -> NDArray[Any]:
    """Read the pixels of an Image, checking its layout but not its values.

    Parameters
    ----------
    msg : sensor_msgs/Image
        Of either message world.
    encodings : tuple of str
        Allowed encodings.
    where : str
        What the message is, for errors.

    Returns
    -------
    ndarray, shape (rows, cols) or (rows, cols, channels)
        complex64 or complex128 for the complex encodings, else float32 or uint8. A read-only view of
        the message's memory where its layout allows; integer pairs, foreign byte order and memory
        that is not aligned are copied once.

    Raises
    ------
    AdapterError
        If encoding, width, height, step, is_bigendian or the length of the data contradict each
        other or the contract.
    """
    check_type(msg, IMAGE, where)
    scalar, channels, is_complex = _layout(msg.encoding, encodings, where)
    rows, cols, step = int(msg.height), int(msg.width), int(msg.step)
    for name, n in (("width", cols), ("height", rows)):
        if not 1 <= n <= MAX_SIDE:
            raise AdapterError(f"{where}.{name} is {n} pixels; expected 1 to {MAX_SIDE}")
    if int(msg.is_bigendian) not in (0, 1):
        raise AdapterError(f"{where}.is_bigendian is {int(msg.is_bigendian)}; expected 0 or 1")
    width_bytes = cols * channels * np.dtype(scalar).itemsize
    if step < width_bytes:
        raise AdapterError(
            f"{where}.step is {step} bytes; expected {width_bytes} ({cols} pixels of {msg.encoding})"
        )
    if step * rows > MAX_BYTES:
        raise AdapterError(
            f"{where} of {rows} rows of {step} bytes has {step * rows} bytes; expected at most {MAX_BYTES}"
        )
    data = np.frombuffer(msg.data, dtype=np.uint8) if len(msg.data) else np.empty(0, np.uint8)
    if data.size != step * rows:
        raise AdapterError(
            f"{where}.data has {data.size} bytes; expected step * height = {step} * {rows} = {step * rows}"
        )
    order: Literal["<", ">"] = ">" if msg.is_bigendian else "<"
    dtype = np.dtype(scalar).newbyteorder(order)
    if is_complex and scalar[0] == "f":
        dtype = np.dtype(f"{order}c{2 * dtype.itemsize}")
        channels = 1
    # A padded step that is no multiple of the pixel cannot be viewed: ndarray takes any stride.
    pixels: NDArray[Any] = np.ndarray(
        (rows, cols, channels),
        dtype,
        buffer=data,
        strides=(step, channels * dtype.itemsize, dtype.itemsize),
    )
    native = dtype.newbyteorder("=")
    if is_complex and scalar[0] == "i":
        as_complex = np.empty((rows, cols), np.complex64)
        as_complex.real = pixels[..., 0]
        as_complex.imag = pixels[..., 1]
        pixels = as_complex
    else:
        # A copy only if the byte order is foreign or the memory not aligned (as in a bag's chunk).
        pixels = np.require(pixels, native, "A")
        if channels == 1 and not _is_voxels(encodings):
            pixels = pixels[..., 0]
    pixels.flags.writeable = False
    return pixels


def image_from_msg(msg: Any, stream_name: str) -> NDArray[Any]:
    """Read an Image of one of the contract's streams.

    Parameters
    ----------
    msg : sensor_msgs/Image
        Of either message world.
    stream_name : str
        ``image``, ``sector``, ``sub_aperture``, ``shadow``, ``likelihood``, ...

    Returns
    -------
    ndarray, shape (rows, cols) or (rows, cols, channels)
        See `pixels_from_msg`.

    Raises
    ------
    AdapterError
        If the frame, the layout or the pixels break the contract.
    """
    kind = stream(stream_name)
    pixels = pixels_from_msg(msg, kind.encodings, kind.image_topic)
    frame_of(msg, kind.image_topic)
    check_pixels(pixels, kind)
    return pixels


def display_to_msg(factory: MessageFactory, picture: NDArray[np.uint8], stamp_ns: int) -> Any:
    """Make the Image (mono8) of a picture for the eye, shape (rows, cols)."""
    if picture.ndim != 2 or picture.dtype != np.uint8:
        raise AdapterError(
            f"picture has shape {picture.shape} of {picture.dtype}; expected (rows, cols) of uint8"
        )
    return factory.make(
        IMAGE,
        header=make_header(factory, stamp_ns),
        height=picture.shape[0],
        width=picture.shape[1],
        encoding="mono8",
        is_bigendian=0,
        step=picture.shape[1],
        data=factory.octets(np.ascontiguousarray(picture)),
    )


def image_to_msg(
    factory: MessageFactory,
    pixels: NDArray[Any],
    stamp_ns: int,
    stream_name: str,
    encoding: str | None = None,
    *,
    trusted: bool = False,
) -> Any:
    """Make an Image of one of the contract's streams.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    pixels : ndarray
        Shape and type as `image_from_msg` returns them. With an integer encoding the values must be
        whole numbers inside its range already (see `quantise`).
    stamp_ns : int
        The view's stamp.
    stream_name : str
        Name of the stream.
    encoding : str, optional
        One of the stream's encodings; its first by default.
    trusted : bool
        The values are known to keep the stream's rule: they are not looked at.

    Raises
    ------
    AdapterError
        If the array does not fit the encoding or its values break the contract.
    """
    kind = stream(stream_name)
    where = kind.image_topic
    if encoding is None:
        encoding = kind.encodings[0]
        if _is_voxels(kind.encodings):
            encoding = f"{encoding[:-1]}{pixels.shape[-1]}"
    scalar, channels, is_complex = _layout(encoding, kind.encodings, where)
    flat = is_complex or (channels == 1 and not _is_voxels(kind.encodings))
    if pixels.ndim != (2 if flat else 3) or (not flat and pixels.shape[2] != channels):
        expected = "(rows, cols)" if flat else f"(rows, cols, {channels})"
        raise AdapterError(f"{where} has shape {pixels.shape}; expected {expected} for {encoding}")
    rows, cols = pixels.shape[:2]
    size = rows * cols * channels * np.dtype(scalar).itemsize
    if size > MAX_BYTES:
        raise AdapterError(f"{where} of {pixels.shape} pixels has {size} bytes; expected at most {MAX_BYTES}")
    if not trusted:
        check_pixels(pixels, kind)
    if is_complex:
        if not np.iscomplexobj(pixels):
            raise AdapterError(f"{where} holds {pixels.dtype}; expected complex numbers for {encoding}")
        if scalar[0] == "f":
            raw = np.ascontiguousarray(pixels, dtype=f"<c{2 * np.dtype(scalar).itemsize}")
        else:
            raw = _integer_pairs(pixels, scalar, encoding, where)
    else:
        if np.iscomplexobj(pixels) or (scalar[0] == "u") != (pixels.dtype.kind == "u"):
            raise AdapterError(f"{where} holds {pixels.dtype}; expected {np.dtype(scalar)} for {encoding}")
        raw = np.ascontiguousarray(pixels, dtype=np.dtype(scalar).newbyteorder("<"))
    return factory.make(
        IMAGE,
        header=make_header(factory, stamp_ns),
        height=rows,
        width=cols,
        encoding=encoding,
        is_bigendian=0,
        step=cols * channels * np.dtype(scalar).itemsize,
        data=factory.octets(raw),
    )


def _integer_pairs(pixels: NDArray[Any], scalar: str, encoding: str, where: str) -> NDArray[Any]:
    limit = np.iinfo(scalar).max
    pairs = np.empty((*pixels.shape, 2), dtype=np.dtype(scalar).newbyteorder("<"))
    for channel, part in enumerate((pixels.real, pixels.imag)):
        peak = float(np.abs(part).max())
        if peak > limit:
            raise AdapterError(f"{where} has a value of {peak:g}; expected at most {limit} for {encoding}")
        whole = np.rint(part)
        if not np.array_equal(whole, part):
            raise AdapterError(
                f"{where} has fractions; expected whole numbers for {encoding} (quantise it first)"
            )
        pairs[..., channel] = whole
    return pairs


def largest_part(pixels: NDArray[Any]) -> float:
    """Return the largest magnitude of a real or imaginary part."""
    return max(float(np.abs(pixels.real).max()), float(np.abs(pixels.imag).max()))


def quantise(pixels: NDArray[Any], encoding: str, peak: float = 0.0) -> NDArray[np.complex64]:
    """Scale a complex image so that its largest part fills an integer encoding, and round.

    Parameters
    ----------
    pixels : ndarray of complex, shape (rows, cols)
        The image.
    encoding : str
        ``8SC2`` or ``16SC2``.
    peak : float
        The part that shall fill it, if images share one scale; at least the image's own.

    Raises
    ------
    AdapterError
        If the encoding is no complex integer one, or the image is not finite or holds only zeros.
    """
    if encoding not in ("8SC2", "16SC2"):
        raise AdapterError(f"encoding is {quoted(encoding)}; expected 8SC2 or 16SC2")
    check_pixels(pixels, stream("image"))
    scale = np.iinfo(_FIXED[encoding][0]).max / max(peak, largest_part(pixels))
    out = np.empty(pixels.shape, np.complex64)
    out.real = np.rint(pixels.real * scale)
    out.imag = np.rint(pixels.imag * scale)
    return out


def check_pixels(pixels: NDArray[Any], kind: ImageStream) -> None:
    """Refuse pixels that break the stream's rule.

    Coherent images must be finite. Views may hold NaN where they know nothing, never infinities;
    amplitudes are not negative, likelihoods lie in [0, 1], masks hold 0, 64, 128 and 255, matter
    0 and 255. An image that holds only zeros, or a view that knows nothing at all, is no measurement.

    Raises
    ------
    AdapterError
        With the number of bad pixels and the first one's place.
    """
    where, content = kind.image_topic, kind.content
    if content == "picture" or _plainly_fine(pixels, kind):
        return
    if content == "mask":
        _refuse(
            ~np.isin(pixels, tuple(_MASK)), pixels, where, "none of 0, 64, 128, 255", "0, 64, 128 or 255"
        )
        return
    if content == "matter":
        _refuse((pixels != 0) & (pixels != 255), pixels, where, "neither 0 nor 255", "0 or 255")
        return
    finite = np.isfinite(pixels)
    if content == "count":
        _refuse(~finite | (pixels < 0), pixels, where, "not counts", "numbers of views, 0 or more")
        return
    if content == "coherent":
        if not finite.all():
            _refuse(~finite, pixels, where, "not finite", "finite numbers")
    else:
        if not finite.all():
            infinite = ~finite & ~np.isnan(pixels)
            _refuse(infinite, pixels, where, "infinite", "finite numbers, or NaN for no data")
        if not finite.any() and not _is_voxels(kind.encodings):
            raise AdapterError(f"{where} holds only NaN; expected at least one pixel with a value")
    if content == "amplitude":
        _refuse(pixels < 0, pixels, where, "negative", "amplitudes of at least 0")
    elif content == "likelihood":
        _refuse((pixels < 0) | (pixels > 1), pixels, where, "outside [0, 1]", "likelihoods in [0, 1]")
        return
    # Not the pixels themselves: a signalling NaN warns.
    if not np.any(pixels != 0, where=finite):
        raise AdapterError(f"{where} holds only zeros; expected an image")


#: The bytes that may be in a mask.
_MASK = bytes((MASK_OUTSIDE, MASK_COVERED, MASK_UNKNOWN, MASK_SHADOW))


def _plainly_fine(pixels: NDArray[Any], kind: ImageStream) -> bool:
    """Say whether lowest and highest number alone show that pixels keep the rule, as they mostly do."""
    if kind.content == "mask":
        return pixels.dtype == np.uint8 and not pixels.tobytes().translate(None, _MASK)
    if kind.content == "count" or pixels.dtype not in (np.complex64, np.complex128, np.float32):
        return False
    numbers = pixels
    if np.iscomplexobj(pixels):
        # Real and imaginary parts as they lie in memory, without a copy.
        numbers = np.ascontiguousarray(pixels).view(pixels.real.dtype)
    if kind.content == "coherent":  # where NaN may not be; it passes through min and max
        low, high = float(numbers.min()), float(numbers.max())
    else:
        low, high = (float(f.reduce(numbers, axis=None)) for f in (np.fmin, np.fmax))
    finite = -math.inf < low <= high < math.inf
    if kind.content == "likelihood":
        return finite and low >= 0.0 and high <= 1.0
    return finite and low < high and (low >= 0.0 or kind.content != "amplitude")


def _refuse(bad: NDArray[np.bool_], pixels: NDArray[Any], where: str, fault: str, expected: str) -> None:
    if not bad.any():
        return
    first = tuple(int(i) for i in np.unravel_index(int(bad.argmax()), bad.shape))
    place = "row {}, column {}".format(*first) + (f", channel {first[2]}" if len(first) > 2 else "")
    with np.errstate(invalid="ignore"):  # a signalling NaN warns even of its text
        value = f"{pixels[first]}"
    raise AdapterError(
        f"{where} has {int(bad.sum())} of {bad.size} pixels {fault}, the first at {place}"
        f" ({value}); expected {expected}"
    )
