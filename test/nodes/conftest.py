"""Fixtures of the node tests: a graph, and a tiny simulated run with its bags."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from csas_shadow_ros.bags import write_run
from csas_shadow_ros.core.pipeline import ProcessedView, Result, run
from csas_shadow_ros.simulation import SimulatedRun, simulate
from msg_adapters import RosbagsMessages, view_to_msgs

if TYPE_CHECKING:
    from graph_of_nodes import Graph


@pytest.fixture
def graph() -> Iterator[Graph]:
    from graph_of_nodes import Graph

    made = Graph()
    yield made
    made.close()


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain that is the test's own."""
    from csas_shadow_ros.graph.processes import DomainReservation

    with DomainReservation() as domain_id:
        yield domain_id


@pytest.fixture(scope="session")
def simulated() -> SimulatedRun:
    return simulate("tiny", "box", seed=1)


@pytest.fixture(scope="session")
def reference(simulated: SimulatedRun) -> tuple[Result, list[ProcessedView]]:
    """The run in one process: the grid that every graph must leave, and all views."""
    from graph_of_nodes import PARAMETERS

    views: list[ProcessedView] = []
    result = run(simulated.image, simulated.track, PARAMETERS, on_view=views.append)
    assert result.grid is not None
    assert result.views_used >= 30
    return result, views


@pytest.fixture(scope="session")
def run_bag(simulated: SimulatedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of image, camera_info and track."""
    return write_run(tmp_path_factory.mktemp("bags") / "run", simulated.image, simulated.track)


@pytest.fixture(scope="session")
def view_bag(
    reference: tuple[Result, list[ProcessedView]], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Make a bag of one stage's views."""
    factory = RosbagsMessages()
    folder = tmp_path_factory.mktemp("view_bags")

    def make(stream: str) -> Path:
        path = folder / stream
        if not path.exists():
            field = {"shadow_mask": "mask"}.get(stream, stream)
            messages = [
                (f"{stream}/{part}", message)
                for view in reference[1]
                for part, message in zip(
                    ("image", "camera_info"), view_to_msgs(factory, getattr(view, field), stream), strict=True
                )
            ]
            write_run(path, None, None, extra=messages)
        return path

    return make
