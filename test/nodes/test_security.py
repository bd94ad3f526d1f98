"""Permissions are as wide as what the nodes open, and what cannot be secured does not work in the clear."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from graph_of_nodes import PARAMETERS, Graph

import csas_shadow_ros
from csas_shadow_ros.graph.replay import replay
from csas_shadow_ros.nodes.runtime.params import NODES
from csas_shadow_ros.security import ros_services, ros_topics

ROOT = Path(csas_shadow_ros.__file__).resolve().parents[1]


def kind_of(name: str) -> Any:
    """Return the class of a node."""
    module = importlib.import_module(f"csas_shadow_ros.nodes.{name}")
    (found,) = (k for k in vars(module).values() if isinstance(k, type) and vars(k).get("name") == name)
    return found


def test_a_node_opens_no_topic_and_no_service_that_its_permissions_do_not_name(
    graph: Graph, run_bag: Path, tmp_path: Path
) -> None:
    own: dict[str, dict[str, Any]] = {
        "bag_player": {"bag": str(run_bag), "clock_hz": 10.0},
        "bag_recorder": {"out": str(tmp_path / "recording")},
        "voxel_carver": {"origin_lat_deg": 48.0, "origin_lon_deg": -4.5, "voxel_size_m": 0.1},
        "sub_aperture": {"step_deg": 30.0},
        "viewer": {"port": 0},
    }
    # The player last: then everybody has opened what a run needs when it is through.
    for name in [*(n for n in NODES if n != "bag_player"), "bag_player"]:
        graph.add(kind_of(name), **own.get(name, {}))
    recorder = next(n for n in graph.nodes if n.name == "bag_recorder")
    graph.spin_until(lambda: len(recorder.state_values()["holds"].split()) >= 15)
    used: set[str] = set()
    for node in graph.nodes:
        name, space = node.get_name(), node.get_namespace()
        hears, publishes = ros_topics(name)
        answers, asks = ros_services(name)
        opened = {t for t, _ in node.get_publisher_names_and_types_by_node(name, space)}
        heard = {t for t, _ in node.get_subscriber_names_and_types_by_node(name, space)}
        assert opened <= publishes, f"{name} publishes {opened - publishes}"
        assert heard <= hears, f"{name} hears {heard - hears}"
        assert {s for s, _ in node.get_service_names_and_types_by_node(name, space)} == answers
        assert {s for s, _ in node.get_client_names_and_types_by_node(name, space)} == asks
        used |= {f"{name} gives {t}" for t in opened}
        # Nor wider: what a node may publish it does, in this run or with other parameters.
        further = {t for t in publishes if "/object_" in t}
        later = {
            *("/tf_static", "/clock", "/csas/progress", "/rosout"),
            *(t for t in publishes if name == "bag_player"),
        }
        assert publishes - further - later <= opened, f"{name}: {publishes - further - later - opened}"
    assert "voxel_carver gives /csas/measurements" in used


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "ROS_SECURITY_ENABLE": "true", **more}


def test_a_node_that_cannot_be_secured_ends_by_name_and_does_not_work_in_the_clear(
    tmp_path: Path, domain: int
) -> None:
    # rcl asks for the folder alone: what is in it is the middleware's affair.
    (tmp_path / "enclaves" / "csas" / "composites").mkdir(parents=True)
    command = [sys.executable, "-m", "csas_shadow_ros.nodes.composites", "--ros-args"]
    command += ["--enclave", "/csas/composites"]
    asked = environment(
        ROS_SECURITY_KEYSTORE=str(tmp_path), ROS_SECURITY_STRATEGY="Enforce", ROS_DOMAIN_ID=str(domain)
    )
    done = subprocess.run(command, env=asked, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith("composites: ROS_SECURITY_ENABLE is true, and no node can be made: ")
    assert len(line) < 300


def test_a_replay_that_cannot_be_secured_ends_by_name(
    run_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "keys" / "enclaves").mkdir(parents=True)
    for name, value in environment(
        ROS_SECURITY_KEYSTORE=str(tmp_path / "keys"), ROS_SECURITY_STRATEGY="Enforce"
    ).items():
        monkeypatch.setenv(name, value)
    from csas_shadow_ros.core.errors import ParameterError

    with pytest.raises(ParameterError, match="ROS_SECURITY_ENABLE is true, and no node can be made: "):
        replay(run_bag, parameters=PARAMETERS, progress=False)
