"""One table names the nodes; whatever else must know a node agrees with it."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from csas_shadow_ros import security
from csas_shadow_ros.cli.main import main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.graph.replay import leave_out
from csas_shadow_ros.node_table import NODES, chain, joins, makers
from csas_shadow_ros.nodes.runtime import params, start
from msg_adapters.topics import STREAMS, VIEW_STREAMS

ROOT = Path(__file__).resolve().parents[2]


def test_parameters_and_permissions_are_of_the_nodes_of_the_table():
    assert set(params.NODES) == set(security.NODES) == set(NODES)


@pytest.mark.parametrize("name", NODES)
def test_each_node_has_a_module_a_class_and_a_program_of_its_name(name):
    module = importlib.import_module(f"csas_shadow_ros.nodes.{name}")
    assert callable(module.main)
    assert getattr(start, name).args == (name,)
    kinds = [kind for kind in vars(module).values() if getattr(kind, "name", None) == name]
    assert [kind.__module__ for kind in kinds] == [module.__name__]


def test_a_program_of_no_node_is_none():
    with pytest.raises(AttributeError, match="no node 'carver'; expected one of: bag_player, "):
        start.carver  # noqa: B018


@pytest.mark.parametrize("name", NODES)
def test_what_a_node_takes_and_gives_is_what_it_may(name):
    node, reach = NODES[name], security.REACH[name]
    assert {*node.takes, *node.gives} <= set(STREAMS)
    assert set(node.takes) <= set(reach.takes)
    assert set(node.gives) <= set(reach.gives)


@pytest.mark.parametrize("stream", ["image", "sector", *VIEW_STREAMS])
def test_every_stream_leads_to_the_grid_through_who_makes_the_next(stream):
    names = chain(stream)
    assert names[-1] == "voxel_carver"
    there = {stream}
    for name in names:
        assert there & set(NODES[name].takes)
        there |= set(NODES[name].gives)
    assert joins("composites", stream) == (stream in ("image", "sector", "sub_aperture"))
    assert stream not in VIEW_STREAMS or (*makers(stream), *names) == chain("sub_aperture") or (
        stream in ("likelihood", "shadow_mask")
    )


@pytest.mark.parametrize(
    ("name", "stage", "reason"),
    [
        ("carver", "image", "without is 'carver'; expected one of: shadow_enhancement, shadow_likelihood"),
        ("voxel_carver", "image", "cannot do without voxel_carver: its grid is the result; expected one of"),
        ("sub_aperture", "sector", "cannot do without sub_aperture: it decides what is carved"),
        ("bag_player", "image", "cannot do without bag_player: it plays the bag"),
        ("bag_recorder", "image", "cannot do without bag_recorder: the results are made of its bag"),
        ("viewer", "image", "cannot do without viewer: only --view starts it"),
        ("shadow_enhancement", "shadow", "'shadow_enhancement', but shadow views do not pass it"),
        ("composites", "likelihood", "'composites', but likelihood views do not pass it"),
    ],
)
def test_a_node_that_a_replay_cannot_leave_out_is_named_with_the_reason(name, stage, reason):
    with pytest.raises(ParameterError, match=re.escape(reason)):
        leave_out([name], stage)


def test_a_replay_leaves_out_what_may_be_replaced():
    assert leave_out(["composites", "shadow_likelihood"], "image") == {"composites", "shadow_likelihood"}


def test_a_replay_without_a_node_that_it_needs_ends_in_one_line(tiny_box_bag, tmp_path, capsys):
    pytest.importorskip("rclpy")
    out = tmp_path / "out"
    command = ["replay", str(tiny_box_bag.path), "--out", str(out), "--without", "voxel_carver"]
    assert main(command) == 1
    told = capsys.readouterr().err.strip().splitlines()
    assert "cannot do without voxel_carver: its grid is the result" in told[-1]
    assert not out.exists()


def test_the_table_is_read_without_any_library():
    code = "import runpy, sys; runpy.run_path('csas_shadow_ros/node_table.py'); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    assert not {"numpy", "rclpy", "csas_shadow_ros"} & set(done.stdout.split())


def test_no_other_file_lists_the_nodes():
    four = ("sub_aperture", "shadow_enhancement", "shadow_likelihood", "voxel_carver")
    for path in (ROOT / "setup.py", ROOT / ".ci" / "run", *sorted((ROOT / "launch").glob("*.py"))):
        text = path.read_text(encoding="utf-8")
        assert not all(name in text for name in four), path
