"""The name of the scene frame, in its own module so that reading it loads no numerical library."""

from __future__ import annotations

from typing import TypeGuard

from .errors import CsasError, InputTypeError, quoted

#: The scene frame's name where nobody gives another one.
SCENE_FRAME = "csas_scene"
#: tf2 and REP 103 set no limit; a name fits a line of the terminal with what was expected.
_MAX_FRAME = 100


def is_frame(value: object) -> TypeGuard[str]:
    """Say whether a value can be the name of a frame."""
    return isinstance(value, str) and bool(value.strip()) and len(value) <= _MAX_FRAME


def check_frame(what: str, value: object, error: type[CsasError] = InputTypeError) -> str:
    """Return the name of the frame that something is in.

    Raises
    ------
    CsasError
        Of the given kind, if it can be none; it names what and value.
    """
    if is_frame(value):
        return value
    raise error(
        f"{what} is {quoted(value)}; expected the name of the scene's frame, such as {SCENE_FRAME!r}"
    )
