"""Libraries that only archives need, with one line that says how to get them."""

from __future__ import annotations

import importlib
from typing import Any

from ..core.errors import MissingExtraError


def need(module: str, what: str, extra: str) -> Any:
    """Import a library of an extra.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise MissingExtraError(
            f"{what} needs {name}, which is not installed; expected: pip install 'csas_shadow_ros[{extra}]'"
        ) from error
