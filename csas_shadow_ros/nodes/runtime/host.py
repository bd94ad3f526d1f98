"""What inlets and outlets need from their node, ours or an outside one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from msg_adapters import RclpyMessages, ViewProgress


class Host(Protocol):
    """Owner of inlets and outlets: `CsasNode`, or `csas_shadow_ros.client` in an outside node."""

    #: Identifies the running process; a successor has another one.
    instance: str
    messages: RclpyMessages
    counts: Counter[str]
    inlets: list[Any]
    #: Why it can take nothing for now; empty if it can.
    unable: str
    #: Stamp of the target that it works for; empty: it needs none, or knows of none.
    target_stamp: str

    @property
    def name(self) -> str:
        """Name of the node."""

    @property
    def scene_frame(self) -> str:
        """The only accepted frame of messages; empty: any single frame per run."""

    @property
    def trouble(self) -> str:
        """What stops it from working; empty if nothing."""

    def publisher(self, topic: str, profile: Any) -> Any:
        """Make a publisher of a topic of the contract."""

    def subscribe(
        self, topic: str, profile: Any, callback: Callable[[Any], None], *, raw: bool = False
    ) -> Any:
        """Subscribe to a topic of the contract; errors of the callback do not end the node."""

    def unsubscribe(self, subscription: Any) -> None:
        """Remove a subscription."""

    def count_publishers(self, topic: str) -> int:
        """Return how many publishers of a topic are known."""

    def leave(self, inlet: Any) -> None:
        """Say goodbye for one inlet."""

    def reject(self, reason: str) -> None:
        """Count and name an unusable item."""

    def send_report(self, item: ViewProgress) -> None:
        """Publish the fate of a view."""

    def now_ns(self) -> int:
        """Return the node's time."""

    def common_counts(self) -> dict[str, int]:
        """Return the counts that every heartbeat carries."""

    def state_values(self) -> dict[str, str]:
        """Return further values for the heartbeat."""
