"""The short form of the harness of kills: a few trials; ``make soak`` is the long one."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from soak import Bags, Trial, live_child, same_draw, two_graphs


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> Bags:
    return Bags(tmp_path_factory.mktemp("soak") / "bags")


def sound(line: dict) -> bool:
    return not line["faults"] and not line["lost"]


@pytest.mark.long
def test_a_replay_whose_processes_are_killed_and_whose_launcher_is_leaves_the_right_grid(bags, tmp_path):
    # Kills nodes, then the launching process, then gives the same command again.
    line = Trial(1, bags, tmp_path / "launcher", "launcher").go()
    assert sound(line), line
    assert "launcher" in {name for _, name in line["kills"]}
    assert line["grids"] == ["right"]


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    [
        *("image", "sector", "shadow", "shadow_mask", "two folders", "one folder", "clock"),
        *("full disk", "read-only", "few files", "little memory", "live"),
    ],
)
def test_a_trial_of_each_kind_ends_as_it_must(bags, tmp_path, kind):
    line = Trial(2, bags, tmp_path / "trial", kind).go()
    assert sound(line), line


@pytest.mark.long
def test_four_replays_at_once_with_one_draw_leave_each_its_own_bags_grid(bags, tmp_path):
    assert same_draw(bags, tmp_path, 1) == []


@pytest.mark.long
def test_two_live_graphs_in_one_domain_and_two_namespaces_leave_each_its_own_grids(bags, tmp_path):
    assert two_graphs(bags, tmp_path, 2, 0) == []


@pytest.mark.long
def test_a_live_graph_under_kills_in_every_circle_leaves_every_grid_and_recording(bags, tmp_path):
    tmp_path.joinpath("live").mkdir()
    more = ["--circles", "4", "--kills", "0", "--kills-a-circle", "3"]
    line = live_child("test", bags, tmp_path / "live", 5, *more)
    assert sound(line), line
    assert line["grids"] == 4
    assert len(line["kills"]) >= 4
