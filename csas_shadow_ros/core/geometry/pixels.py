"""What arrays a picture or a track may be made of."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MAX_STAMP_NS, GeometryError, InputTypeError, ParameterError, TrackError, quoted

#: Numbers of a coherent image.
COHERENT = ("complex64", "complex128")
#: Numbers of a view: sub-aperture, amplitude or likelihood, mask.
OF_A_VIEW = (*COHERENT, "float32", "float64", "uint8")


def check_pixels(
    what: str, pixels: object, shape: tuple[int, int], says: str, kinds: tuple[str, ...]
) -> None:
    """Raise unless pixels are an array of a shape and kind; their values are not looked at.

    Parameters
    ----------
    what, says : str
        What they are of, and what says their shape, for the message.
    pixels : object
        The pixels.
    shape : (int, int)
        Expected (rows, cols).
    kinds : tuple of str
        Expected types of numbers.

    Raises
    ------
    InputTypeError
        If they are no array, or hold something else.
    GeometryError
        If they have another shape.
    """
    if not isinstance(pixels, np.ndarray):
        raise InputTypeError(
            f"pixels of the {what} are a {type(pixels).__name__}; expected an array of numpy"
        )
    if pixels.dtype.name not in kinds:
        raise InputTypeError(f"pixels of the {what} are {pixels.dtype}; expected {' or '.join(kinds)}")
    if pixels.shape != shape:
        raise GeometryError(f"{what} has {pixels.shape} pixels; its {says} says {shape} (rows, cols)")


def check_finite_pixels(what: str, pixels: NDArray[Any]) -> None:
    """Raise unless every pixel is a finite number.

    Raises
    ------
    ParameterError
        With the number of bad pixels and the first one's place and value.
    """
    # A repeated row or column, as of a blank image that takes no memory, is looked at once.
    distinct = pixels[tuple(slice(None) if step else slice(1) for step in pixels.strides)]
    # One pixel that is not finite spoils the sum. So do numbers that are too large to add: look again.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(distinct.sum()):
            return
    bad = ~np.isfinite(distinct)
    if bad.any():
        first = tuple(int(i) for i in np.unravel_index(int(bad.argmax()), bad.shape))
        count = int(bad.sum()) * (pixels.size // distinct.size)
        raise ParameterError(
            f"{what} has {count} of {pixels.size} pixels not finite,"
            f" the first at row {first[0]}, column {first[1]} ({pixels[first]}); expected finite numbers, 0"
            " where nothing was seen"
        )


def stamps_of(what: str, values: ArrayLike) -> NDArray[np.int64]:
    """Return the stamps of something, ns, as an array of its own.

    Raises
    ------
    InputTypeError
        If they are no whole numbers.
    TrackError
        If no message can carry one.
    """
    stamps = _whole(f"stamps (ns) of the {what}", values)
    wrong = (stamps < 0) | (stamps > MAX_STAMP_NS)
    if wrong.any():
        raise TrackError(
            f"stamp {stamps[wrong][0]} of the {what} is no time; expected [0, {MAX_STAMP_NS}] ns"
        )
    return stamps


def indices_of(what: str, values: ArrayLike) -> NDArray[np.int64]:
    """Return indices as an array of its own.

    Raises
    ------
    InputTypeError
        If they are no whole numbers.
    """
    return _whole(what, values).reshape(-1)


def positions_of(what: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return positions, metres, as an array of its own, of whatever shape.

    Raises
    ------
    InputTypeError
        If they are no real numbers.
    """
    given = _array(f"positions of the {what}", values, "numbers of shape (n, 3)")
    if given.size and given.dtype.kind not in "fiu":
        raise InputTypeError(
            f"positions of the {what} are {given.dtype}, the first {quoted(given.flat[0])}; expected real"
            " numbers, metres"
        )
    return np.array(given, dtype=np.float64)


def _whole(what: str, values: ArrayLike) -> NDArray[np.int64]:
    given = _array(what, values, "whole numbers")
    if given.size and given.dtype.kind not in "iu":
        first = quoted(given.ravel().tolist()[0])
        raise InputTypeError(f"{what} are {given.dtype}, the first {first}; expected whole numbers")
    return np.array(given, dtype=np.int64)


def _array(what: str, values: ArrayLike, expected: str) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError:  # rows of several lengths
        raise InputTypeError(f"{what} make no array; expected {expected}") from None
