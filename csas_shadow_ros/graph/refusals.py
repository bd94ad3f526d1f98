"""The views that a replay's graph refused."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

from msg_adapters.progress import REJECTED, ViewProgress


@dataclass(frozen=True)
class RejectedView:
    """A view that was not used.

    Parameters
    ----------
    node : str
        Who refused it.
    stamp_ns : int
        Its stamp.
    aspect_deg : float
        Its aspect; NaN if it was not legible.
    reason : str
        Why.
    """

    node: str
    stamp_ns: int
    aspect_deg: float
    reason: str


class Refusals:
    """Follow what becomes of views, and keep those that stay refused.

    A view that a node refuses may come again and be taken. Nobody waits for that: the run may have ended
    without it.
    """

    def __init__(self) -> None:
        self._views: dict[tuple[int, str], RejectedView] = {}
        self._taken: set[tuple[str, int]] = set()

    def __bool__(self) -> bool:
        return bool(self._views)

    def hear(self, item: ViewProgress) -> None:
        """Take a report on a view."""
        name = item.node, item.stamp_ns
        if item.outcome != REJECTED:
            self._taken.add(name)
            return
        self._taken.discard(name)
        aspect = item.values.get("aspect_deg", "")
        view = RejectedView(item.node, item.stamp_ns, float(aspect or "nan"), item.reason)
        self._views.setdefault((item.stamp_ns, aspect), view)

    def listed(self, in_grid: Container[int] = ()) -> list[RejectedView]:
        """Return the refused views by stamp, then aspect.

        Without those that the same node has taken since and that are in the grid, whose stamps are given.
        """
        left = [
            view
            for view in self._views.values()
            if view.stamp_ns not in in_grid or (view.node, view.stamp_ns) not in self._taken
        ]
        return sorted(left, key=lambda view: (view.stamp_ns, view.aspect_deg))
