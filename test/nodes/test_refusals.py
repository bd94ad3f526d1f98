"""What becomes of views that a node of a replay refuses."""

from __future__ import annotations

from csas_shadow_ros.graph.refusals import Refusals
from msg_adapters.progress import INTEGRATED, PUBLISHED, REJECTED, Level, ViewProgress


def said(node: str, stamp_ns: int, outcome: str, aspect_deg: str = "10") -> ViewProgress:
    reason = "all its pixels are 0" if outcome == REJECTED else ""
    level = Level.WARN if reason else Level.OK
    return ViewProgress(stamp_ns, node, "graph:1:1", outcome, reason, level, {"aspect_deg": aspect_deg})


def test_a_refused_view_that_comes_again_put_right_counts_no_more_once_it_is_in_the_grid() -> None:
    """An outside stage refused a view, took it when it came again, and it was counted twice."""
    refusals = Refusals()
    refusals.hear(said("shadow_likelihood", 5, REJECTED))
    refusals.hear(said("shadow_likelihood", 5, REJECTED))
    assert [view.stamp_ns for view in refusals.listed({5})] == [5]
    refusals.hear(said("shadow_likelihood", 5, PUBLISHED))
    assert refusals.listed({4, 5}) == []
    # The grid was finished meanwhile: "33 of 36 in the grid, 0 not used, 0 lost".
    assert [view.stamp_ns for view in refusals.listed({4})] == [5]
    refusals.hear(said("shadow_likelihood", 5, REJECTED))
    assert [view.stamp_ns for view in refusals.listed({4, 5})] == [5]


def test_a_view_stays_refused_that_another_node_or_another_view_of_its_node_passes() -> None:
    refusals = Refusals()
    refusals.hear(said("voxel_carver", 7, REJECTED, "70"))
    refusals.hear(said("composites", 5, REJECTED, "nan"))
    refusals.hear(said("shadow_likelihood", 7, PUBLISHED, "70"))
    refusals.hear(said("voxel_carver", 6, INTEGRATED, "60"))
    assert [(view.stamp_ns, view.node) for view in refusals.listed({5, 6, 7})] == [
        (5, "composites"),
        (7, "voxel_carver"),
    ]
