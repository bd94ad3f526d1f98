"""Equality of what may hold NaN: not given, not measured.

NaN differs from NaN. Python up to 3.12 compared a dataclass as a tuple, which takes one NaN object as equal
to itself; 3.13 compares its numbers, and a copy from another process differs from its original in every
Python. Whoever asks whether two parameter sets or views are the same means "not given" by NaN.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

C = TypeVar("C", bound=type[Any])


class _NotGiven:
    """Stands for every NaN: equal to itself, and to nothing else."""


def _told(value: object) -> object:
    if isinstance(value, float) and math.isnan(value):
        return _NotGiven
    return tuple(_told(item) for item in value) if isinstance(value, tuple) else value


def _fields(one: Any) -> tuple[object, ...]:
    return tuple(_told(getattr(one, f.name)) for f in dataclasses.fields(one) if f.compare)


def equal_where_nan(cls: C) -> C:
    """Decorate a frozen dataclass: two are equal, and hash alike, where both hold NaN in a field.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @equal_where_nan
    ... @dataclass(frozen=True)
    ... class Depth:
    ...     metres: float = float("nan")
    >>> Depth(float("nan")) == Depth(float("nan")), Depth(1.0) == Depth()
    (True, False)
    """

    def equal(self: Any, other: object) -> bool:
        return _fields(self) == _fields(other) if other.__class__ is self.__class__ else NotImplemented

    def hashed(self: Any) -> int:
        return hash((self.__class__, _fields(self)))

    cls.__eq__ = equal  # type: ignore[assignment]
    cls.__hash__ = hashed  # type: ignore[assignment]
    return cls
