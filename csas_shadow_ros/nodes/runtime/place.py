"""A scene's place on earth, from parameters or topic `origin`, for `scene_transform` and `/tf_static`."""

from __future__ import annotations

import importlib
import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.geometry import SCENE_FRAME, Datum, Origin, origin_of
from csas_shadow_ros.core.parameters import PlaceParameters
from msg_adapters import origin_from_msg, origin_to_msg, scene_transform_to_msg

from .. import qos
from .params import part

if TYPE_CHECKING:
    from .base import CsasNode

#: Origins that are kept: a mission says one for each contact, and runs that are not over are few.
_MOST = 64


class PlaceOnEarth:
    """The datum of each run of a node, and its publishers.

    Parameters
    ----------
    node : CsasNode
        The node; among its parameters are `PlaceParameters`, ``parent_frame``, ``parent_lat_deg`` and
        ``parent_lon_deg``.
    on_changed : callable
        Called when another origin came: what was published may have another place.

    Raises
    ------
    ParameterError
        If the scene is to be its own parent.
    """

    def __init__(self, node: CsasNode, on_changed: Callable[[], None]) -> None:
        p = node.parameters
        self._node, self._on_changed = node, on_changed
        self._given = part(p, PlaceParameters)
        self._parent = p.parent_frame
        if self._parent == (p.scene_frame or SCENE_FRAME) or not self._parent:
            raise ParameterError(
                f"parent_frame is {self._parent!r}; expected a frame other than the scene's"
            )
        self._parent_deg = None if math.isnan(p.parent_lat_deg) else (p.parent_lat_deg, p.parent_lon_deg)
        self._origins: deque[Origin] = deque(maxlen=_MOST)
        self._told: dict[str, Any] = {}
        self._transform = node.publisher("scene_transform", qos.LATCHED)
        self._tf = _tf_static(node)
        self._origin = None
        if self._given.given:
            self._origin = node.publisher("origin", qos.LATCHED)
            if node.scene_frame:
                self.publish(node.scene_frame, None, None)
        else:
            node.subscribe_latched("origin", self._take)

    def _take(self, msg: Any) -> None:
        origin = origin_from_msg(msg)
        if origin in self._origins:
            return
        self._origins.append(origin)
        datum = self._given.datum(origin.datum)
        if datum is not None:
            self._tell(Origin(origin.stamp_ns, origin.frame, datum))
        self._on_changed()

    def publish(self, frame: str, run_ns: int | None, last_ns: int | None) -> Datum | None:
        """Return and publish the datum of a run.

        Parameters
        ----------
        frame : str
            Frame of the run.
        run_ns, last_ns : int or None
            Stamps of its first and last pose, where a track tells them.
        """
        said = origin_of(self._origins, frame, last_ns)
        datum = self._given.datum(None if said is None else said.datum)
        if datum is not None:
            # Of a datum that is given it is said that it is this run's: its recording is complete by that.
            stamp = said.stamp_ns if said is not None and not self._given.given else run_ns or 0
            self._tell(Origin(stamp, frame, datum))
        return datum

    def _tell(self, origin: Origin) -> None:
        if self._told.get(origin.frame) == origin:
            return
        self._told[origin.frame] = origin
        messages = self._node.messages
        transform = scene_transform_to_msg(messages, origin, self._parent, self._parent_deg)
        self._transform.publish(transform)
        if self._origin is not None:
            self._origin.publish(origin_to_msg(messages, origin))
        if self._tf is not None:
            kind, publisher = self._tf
            publisher.publish(kind(transforms=[transform]))


def _tf_static(node: CsasNode) -> tuple[Any, Any] | None:
    """Make the publisher of `/tf_static`; None where tf2_msgs is not installed, as beside PyPI's wheels."""
    try:
        kind = importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None
    return kind, node.own_publisher(kind, "/tf_static", qos.LATCHED)
