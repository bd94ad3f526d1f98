"""Errors of the package: one root, so that a caller can catch everything that we raise."""

from __future__ import annotations


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
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} is {value!r}; expected a number") from None
    inside = (low < number if open_low else low <= number) and number <= high
    if not inside:  # also true for NaN
        bracket = "(" if open_low else "["
        unit = f" {unit}" if unit else ""
        raise ParameterError(f"{name} is {value}{unit}; expected {bracket}{low:g}, {high:g}]{unit}")
    return number
