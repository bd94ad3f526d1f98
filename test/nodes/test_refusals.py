"""What becomes of views that a node of a replay refuses."""

from __future__ import annotations

from csas_shadow_ros.graph.refusals import Refusals
from msg_adapters.progress import INTEGRATED, PUBLISHED, REJECTED, Level, ViewProgress


def said(node: str, stamp_ns: int, outcome: str, aspect_deg: str = "10") -> ViewProgress:
    reason = "all its pixels are 0" if outcome == REJECTED else ""
    level = Level.WARN if reason else Level.OK
    return ViewProgress(stamp_ns, node, "graph:1:1", outcome, reason, level, {"aspect_deg": aspect_deg})


def test_a_refused_view_that_comes_again_put_right_counts_once() -> None:
    """An outside classifier's view was refused, sent again, and stood in the summary twice."""
    refusals = Refusals()
    refusals.hear(said("shadow_likelihood", 5, REJECTED))
    refusals.hear(said("shadow_likelihood", 5, REJECTED))
    assert [view.stamp_ns for view in refusals.listed()] == [5]
    refusals.hear(said("shadow_likelihood", 5, PUBLISHED))
    assert not refusals


def test_a_view_stays_refused_that_another_node_or_another_view_of_its_node_passes() -> None:
    refusals = Refusals()
    refusals.hear(said("voxel_carver", 7, REJECTED, "70"))
    refusals.hear(said("composites", 5, REJECTED, "nan"))
    refusals.hear(said("shadow_likelihood", 7, PUBLISHED, "70"))
    refusals.hear(said("voxel_carver", 6, INTEGRATED, "60"))
    assert [(view.stamp_ns, view.node) for view in refusals.listed()] == [
        (5, "composites"),
        (7, "voxel_carver"),
    ]
