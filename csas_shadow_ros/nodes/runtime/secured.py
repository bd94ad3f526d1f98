"""Replace the middleware's traceback by one line if a node cannot be secured (SROS 2)."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator

from csas_shadow_ros.core.errors import ParameterError


@contextlib.contextmanager
def security_told() -> Iterator[None]:
    """Say why a node cannot be made under ROS_SECURITY_ENABLE.

    A middleware without security, missing keys or wrong ones: none of them goes away by another try, and a
    node never works in the clear instead.

    Raises
    ------
    ParameterError
        If the middleware raises within.
    """
    if os.environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        yield
        return
    with warnings.catch_warnings():
        # rclpy's of the half-made node that it drops.
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            yield
        except RuntimeError as error:  # rclpy's own errors
            reason = str(error).splitlines()[0].removeprefix("error creating node: ")
            raise ParameterError(
                f"ROS_SECURITY_ENABLE is true, and no node can be made: {reason}; expected a middleware with"
                " security and keys for this enclave and domain (csas-shadow keys)"
            ) from None
