"""Errors of the package: one root, so that a caller can catch everything that we raise."""

from __future__ import annotations

import math
import operator
from numbers import Complex, Real

#: The latest stamp of ROS 2: int32 seconds and a second's nanoseconds.
MAX_STAMP_NS = (1 << 31) * 1_000_000_000 - 1
#: So many characters of a value are quoted: an encoding or a frame is shorter, and a line of the terminal
#: holds it with what was expected.
MAX_QUOTED = 40


class CsasError(Exception):
    """Root of every error that this package raises on purpose."""


class ParameterError(CsasError, ValueError):
    """A parameter is out of range; the message gives its name, value and bounds."""


class GeometryError(CsasError, ValueError):
    """A grid, camera or position is not usable as the geometry of an image."""


class TrackError(GeometryError):
    """A track is not usable: too short, out of order, not a circle round the scene."""


class ViewError(CsasError, ValueError):
    """One view cannot be used; the run goes on without it."""


class InputTypeError(CsasError, TypeError):
    """An argument is of the wrong kind; the message gives its name, its kind and what was expected."""


class NoTargetError(CsasError, ValueError):
    """A required target was neither given nor found."""


class SpectrumSignError(CsasError, ValueError):
    """The image contradicts its stated spectrum sign: its shadows fall towards the sonar."""


#: What a message's error may take: a few lines of a terminal. Values that are quoted are cut before.
_MOST_CHARACTERS = 290


class AdapterError(CsasError, ValueError):
    """A message breaks the contract; the error names the field, the value and what was expected.

    One line, whatever the message holds: what is longer loses its middle.
    """

    def __init__(self, text: str) -> None:
        line = " ".join("".join(c if c.isprintable() else " " for c in text[:10_000]).split())
        if len(line) > _MOST_CHARACTERS:
            half = _MOST_CHARACTERS // 2
            line = f"{line[:half]} … {line[-half + 3 :]}"
        super().__init__(line)


class BagError(CsasError, ValueError):
    """A bag cannot be read or breaks the contract."""


class MissingExtraError(CsasError, ImportError):
    """A library of one function is not installed; the message names the extra that brings it."""


def quoted(value: object) -> str:
    """Quote a value for an error, on one line: a text in quotation marks, cut to about 40 characters.

    Examples
    --------
    >>> quoted("map")
    "'map'"
    >>> quoted("m" * 1_000_000)
    "'mmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmmm'… (1000000 characters)"
    """
    if isinstance(value, str):
        if len(value) > MAX_QUOTED:
            return f"{value[:MAX_QUOTED]!r}… ({len(value)} characters)"
        return repr(value)
    text = " ".join(repr(value).split())
    return text if len(text) <= 2 * MAX_QUOTED else f"{text[:MAX_QUOTED]}…"


def check_type(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raise unless an argument is of a kind.

    Parameters
    ----------
    name : str
        What the value is, for the message.
    value : object
        The value.
    kind : type or tuple of type
        What it may be.
    expected : str
        The same in words.

    Raises
    ------
    InputTypeError
        If it is something else.
    """
    if not isinstance(value, kind):
        raise InputTypeError(f"{name} is a {type(value).__name__}; expected {expected}")


def check_number(name: str, value: object) -> float:
    """Return a value as a float, finite or not; a text is no number, whatever it says.

    Parameters
    ----------
    name : str
        What the value is, for the message.
    value : object
        The value.

    Raises
    ------
    ParameterError
        If it is no real number.
    """
    try:
        if isinstance(value, str | bytes | bytearray):
            raise TypeError
        if isinstance(value, Complex) and not isinstance(value, Real):  # numpy would drop its imaginary part
            raise TypeError
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ParameterError(f"{name} is {quoted(value)}; expected a number") from None


def check_finite(name: str, value: object, unit: str = "") -> float:
    """Return a value as a float.

    Raises
    ------
    ParameterError
        If it is no finite real number.
    """
    number = check_number(name, value)
    if not math.isfinite(number):
        raise ParameterError(f"{name} is {number}{unit and f' {unit}'}; expected a finite number")
    return number


def check_numbers(name: str, values: object, count: int, unit: str = "") -> tuple[float, ...]:
    """Return so many finite numbers as floats.

    Raises
    ------
    ParameterError
        If they are not so many, or one is no finite number.
    """
    try:
        parts = [] if isinstance(values, str | bytes) else list(values)  # type: ignore[call-overload]
    except TypeError:
        parts = []
    if len(parts) != count:
        many = {2: "two", 3: "three"}.get(count, count)
        raise ParameterError(f"{name} is {quoted(values)}; expected {many} numbers")
    return tuple(check_finite(name, part, unit) for part in parts)


def check_whole(name: str, value: object, low: int, high: int, unit: str = "") -> int:
    """Return a value as an int.

    Raises
    ------
    InputTypeError
        If it is no whole number, as 2.0 is none.
    ParameterError
        If it is outside [low, high].
    """
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise InputTypeError(f"{name} is {quoted(value)}; expected a whole number") from None
    if not low <= number <= high:
        unit = f" {unit}" if unit else ""
        raise ParameterError(f"{name} is {quoted(number)}{unit}; expected [{low}, {high}]{unit}")
    return number


def check_stamp(what: str, value: object) -> int:
    """Return the stamp of something as an int; 0 where it is not known.

    Raises
    ------
    InputTypeError
        If it is no whole number: a double holds the time since 1970 to 256 ns alone.
    ParameterError
        If no message can carry it.
    """
    return check_whole(f"stamp (ns) of the {what}", value, 0, MAX_STAMP_NS, "ns")


def check_divides_circle(
    name: str, angle_deg: float, unit: str = " deg", *, off_deg: float = math.degrees(1e-6)
) -> None:
    """Refuse an angle of which no whole number makes a circle.

    Parameters
    ----------
    name : str
        What the angle is, for the message.
    angle_deg : float
        The angle, over 0.
    unit : str
        How the message writes degrees.
    off_deg : float
        The steps may miss 360° by so much.

    Raises
    ------
    ParameterError
        If the angle does not divide the circle.

    Examples
    --------
    >>> check_divides_circle("step_deg", 5.0)
    >>> check_divides_circle("step_deg", 7.0)
    Traceback (most recent call last):
        ...
    csas_shadow_ros.core.errors.ParameterError: step_deg is 7 deg; expected a divisor of 360 deg (such as ...)
    """
    if abs(math.remainder(360.0, angle_deg)) > off_deg:
        expected = f"expected a divisor of 360{unit} (such as 1, 5, 10)"
        raise ParameterError(f"{name} is {angle_deg:g}{unit}; {expected}")


def check_range(
    name: str, value: float, low: float, high: float, unit: str = "", *, open_low: bool = False
) -> float:
    """Return `value` if it is finite and inside [low, high], else raise.

    Parameters
    ----------
    name : str
        What the value is, for the message.
    value : float
        The value.
    low, high : float
        Bounds, inclusive; with `open_low` the lower bound itself is refused.
    unit : str
        Unit, for the message.

    Raises
    ------
    ParameterError
        If the value is not a finite number inside the bounds.
    """
    number = check_number(name, value)
    inside = (low < number if open_low else low <= number) and number <= high
    if not inside:  # also true for NaN
        bracket = "(" if open_low else "["
        unit = f" {unit}" if unit else ""
        raise ParameterError(f"{name} is {value}{unit}; expected {bracket}{low:g}, {high:g}]{unit}")
    return number
