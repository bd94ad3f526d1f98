"""The views that a replay's graph refused."""

from __future__ import annotations

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

    A view that a node refuses may come again, put right; it counts as refused until the node takes it.
    """

    def __init__(self) -> None:
        self._views: dict[tuple[int, str], RejectedView] = {}

    def __bool__(self) -> bool:
        return bool(self._views)

    def hear(self, item: ViewProgress) -> None:
        """Take a report on a view."""
        key = item.stamp_ns, item.values.get("aspect_deg", "")
        if item.outcome == REJECTED:
            aspect = float(item.values.get("aspect_deg", "nan"))
            self._views.setdefault(key, RejectedView(item.node, item.stamp_ns, aspect, item.reason))
            return
        for other, view in list(self._views.items()):
            if (view.node, view.stamp_ns) == (item.node, item.stamp_ns):
                del self._views[other]

    def listed(self) -> list[RejectedView]:
        """Return the refused views by stamp, then aspect."""
        return sorted(self._views.values(), key=lambda view: (view.stamp_ns, view.aspect_deg))
