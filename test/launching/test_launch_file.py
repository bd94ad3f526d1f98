"""The launch file: every argument is passed on or refused, and what it starts works."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from following import ROOT, Started

from csas_shadow_ros.cli import build_parser
from csas_shadow_ros.core.geometry import Track
from csas_shadow_ros.nodes.runtime.params import NODES

Follow = Callable[..., Started]

#: What each mode is asked for with.
MODES = {
    "replay": {"bag": "a_bag"},
    "play": {"bag": "a_bag", "results": "none"},
    "live": {},
}
#: Another value than the default of each argument.
OTHER = {
    "bag": "another_bag",
    "results": "elsewhere",
    "expect": "expect.yaml",
    "stage": "shadow",
    "rate": "2.0",
    "params": str(ROOT / "constraints"),
    "domain_id": "77",
    "discovery_range": "SUBNET",
    "origin_lat_deg": "48.0",
    "origin_lon_deg": "-4.5",
    "origin_heading_deg": "30.0",
    "scene_frame": "auv_1/scene",
    "parent_frame": "map",
    "namespace": "auv_1",
    "use_sim_time": "true",
    "out": "a_recording",
    "composites": "false",
    "viewer": "true",
    "respawn": "false",
    "shared_memory": "false",
}


def test_the_arguments_are_those_that_are_tried_here(launched: Any) -> None:
    assert set(launched.module.ARGUMENTS) == set(OTHER)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", OTHER)
def test_every_argument_is_passed_on_or_refused(launched: Any, tmp_path: Path, mode: str, name: str) -> None:
    params = tmp_path / "params.yaml"
    params.write_text("/**:\n  ros__parameters:\n    step_deg: 5.0\n")
    plain = launched(**MODES[mode])
    value = str(params) if name == "params" else OTHER[name]
    if getattr(launched.module, mode.upper()) not in launched.module.ARGUMENTS[name][1]:
        with pytest.raises(RuntimeError, match=f"{name} is '.*', which .* cannot take; expected it with"):
            launched(**(MODES[mode] | {name: value}))
    else:
        assert launched(**(MODES[mode] | {name: value})).told() != plain.told(), f"{name} goes nowhere"


def test_what_is_passed_on_comes_to_the_nodes_that_it_is_for(launched: Follow) -> None:
    started = launched(
        bag="a_bag",
        results="none",
        stage="shadow",
        rate="2",
        namespace="auv_1",
        scene_frame="auv_1/scene",
        out="made",
        use_sim_time="true",
        origin_lat_deg="48",
        origin_lon_deg="-4.5",
        parent_frame="map",
        viewer="true",
        domain_id="5",
    )
    assert set(started.commands) == set(NODES)
    for node in NODES:
        own = started.parameters(node)
        assert (own["scene_frame"], own["use_sim_time"]) == ("auv_1/scene", True)
        assert "__ns:=/auv_1" in started.commands[node]
        NODES[node].from_mapping({k: v for k, v in own.items() if k != "use_sim_time"})
    player = started.parameters("bag_player")
    assert (player["bag"], player["stage"], player["rate"]) == ("a_bag", "shadow", 2.0)
    assert started.parameters("bag_recorder")["out"] == "made"
    carver = started.parameters("voxel_carver")
    assert (carver["origin_lat_deg"], carver["origin_lon_deg"], carver["parent_frame"]) == (48.0, -4.5, "map")
    assert started.environment["ROS_DOMAIN_ID"] == "5"


def test_a_replay_gets_a_command_line_that_it_understands(launched: Follow) -> None:
    given = {"origin_lat_deg": "-48", "origin_lon_deg": "-4.5", "domain_id": "5", "stage": "shadow"}
    (command,) = launched(bag="bags/a_bag", rate="2", **given).commands.values()
    # Not by the Python of ros2: apt's sees nothing of the environment that holds the package's libraries.
    assert command[0].endswith("/lib/csas_shadow_ros/csas-shadow")
    parsed = build_parser().parse_args(command[1:])
    assert (parsed.bag, parsed.out, parsed.start_from) == ("bags/a_bag", "results/a_bag", "shadow")
    assert (parsed.p_origin_lat_deg, parsed.p_origin_lon_deg, parsed.domain_id) == (-48.0, -4.5, 5)
    assert parsed.rate == 2.0


@pytest.mark.parametrize(
    ("shell", "argument", "expected"),
    [
        (None, "auto", "LOCALHOST"),
        ("", "auto", "LOCALHOST"),
        ("SUBNET", "auto", "SUBNET"),
        ("off", "auto", "OFF"),
        (None, "SUBNET", "SUBNET"),
        ("SUBNET", "LOCALHOST", "LOCALHOST"),
    ],
)
def test_live_nodes_stay_on_this_machine_unless_somebody_says_otherwise(
    launched: Follow, monkeypatch: pytest.MonkeyPatch, shell: str | None, argument: str, expected: str
) -> None:
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    if shell is not None:
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", shell)
    for mode in ("live", "play"):
        started = launched(**MODES[mode], discovery_range=argument)
        seen = {**os.environ, **started.environment}
        assert seen["ROS_AUTOMATIC_DISCOVERY_RANGE"] == expected


def test_a_range_that_the_shell_says_and_that_there_is_not_is_refused(
    launched: Follow, monkeypatch: pytest.MonkeyPatch
) -> None:
    # rcl only warns of it, and takes the whole subnet.
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCAL")
    with pytest.raises(RuntimeError, match="ROS_AUTOMATIC_DISCOVERY_RANGE is 'LOCAL'; expected one of"):
        launched()


def test_each_node_is_told_the_enclave_of_its_keys(launched: Follow) -> None:
    from csas_shadow_ros.security import enclave_path

    for namespace, space in (("csas", "/csas"), ("/auv_1/csas/", "auv_1/csas"), ("none", "")):
        started = launched(bag="a_bag", results="none", namespace=namespace, out="made", viewer="true")
        assert set(started.commands) == set(NODES)
        for node, command in started.commands.items():
            assert command[command.index("--enclave") + 1] == enclave_path(node, space)


@pytest.mark.parametrize("nothing", ["none", "", "''", '""'])
def test_no_results_means_nodes_that_stay(launched: Follow, nothing: str) -> None:
    assert "bag_player" in launched(bag="a_bag", results=nothing).commands
    assert "bag_player" not in launched(bag=nothing, results="auto").commands


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"namespce": "auv_1"}, "there is no argument 'namespce'; expected one of: bag, results"),
        ({"viewer": "yes"}, "viewer is 'yes'; expected true or false"),
        (
            {"discovery_range": "world"},
            "discovery_range is 'world'; expected one of: LOCALHOST, SUBNET, OFF, SYSTEM_DEFAULT",
        ),
        ({"origin_lat_deg": "north"}, "origin_lat_deg is 'north'; expected a number"),
        ({"results": "somewhere"}, "results is 'somewhere', which nodes without a bag cannot take"),
    ],
)
def test_what_cannot_be_passed_on_is_refused_by_name(
    launched: Follow, arguments: dict[str, str], match: str
) -> None:
    with pytest.raises(RuntimeError, match=match):
        launched(**arguments)


def test_a_node_that_refuses_its_parameters_ends_the_launch_and_one_that_dies_does_not(launched: Any) -> None:
    class Event:
        process_name = "voxel_carver-4"

        def __init__(self, code: int) -> None:
            self.returncode = code

    assert launched.module.end_if_refused(Event(-9), None) is None
    with pytest.raises(RuntimeError, match="voxel_carver-4 refused what it was given"):
        launched.module.end_if_refused(Event(2), None)
    with pytest.raises(RuntimeError, match="csas-shadow replay ended with 1"):
        launched.module.end_of_replay(Event(1), None)


def final_measurements(domain: int, namespaces: Sequence[str]) -> dict[str, Any]:
    """Listen, for two minutes at most, until each namespace has published its final result."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    from csas_shadow_ros.nodes import qos
    from msg_adapters import TOPICS, RclpyMessages, measurements_from_msg

    kind = RclpyMessages().cls(TOPICS["measurements"].type_name)
    got: dict[str, Any] = {}

    def take(namespace: str, msg: Any) -> None:
        told = measurements_from_msg(msg)
        if told.final:
            got[namespace] = told

    context = Context()
    with ExitStack() as stack:
        rclpy.init(context=context, domain_id=domain)
        stack.callback(rclpy.try_shutdown, context=context)
        node = rclpy.create_node("listener", context=context)
        stack.callback(node.destroy_node)
        executor = SingleThreadedExecutor(context=context)
        stack.callback(executor.shutdown)
        executor.add_node(node)
        for name in namespaces:
            node.create_subscription(
                kind, f"/{name}/measurements", lambda msg, name=name: take(name, msg), qos.LATCHED
            )
        end = time.monotonic() + 120.0
        while len(got) < len(namespaces) and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
    return got


@pytest.mark.long
def test_two_vehicles_in_one_domain_have_results_and_frames_of_their_own(
    launched: Follow, tmp_path: Path, tiny_box_bag: Any, domain: int
) -> None:
    """Each plays its own bag in its own namespace; a listener in the same domain hears both."""
    pytest.importorskip("rclpy")
    from csas_shadow_ros.bags import write_run

    made = tiny_box_bag.run
    params = tmp_path / "params.yaml"
    params.write_text(
        "/**/sub_aperture:\n  ros__parameters:\n    step_deg: 20.0\n"
        "/**/voxel_carver:\n  ros__parameters:\n    voxel_size_m: 0.08\n"
    )
    with ExitStack() as stack:
        for vehicle in ("auv_1", "auv_2"):
            frame = f"{vehicle}/scene"
            track = Track(made.track.stamps_ns, made.track.positions_m, frame=frame)
            bag = write_run(tmp_path / vehicle, replace(made.image, frame=frame), track)
            started = launched(
                bag=str(bag),
                results="none",
                namespace=vehicle,
                scene_frame=frame,
                params=str(params),
                composites="false",
                domain_id=str(domain),
                origin_lat_deg="48",
                origin_lon_deg=vehicle[-1],
            )
            environment = os.environ | started.environment | {"PYTHONPATH": str(ROOT)}
            for name, command in started.commands.items():
                log = stack.enter_context((tmp_path / f"{vehicle}.{name}.log").open("w"))
                process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
                stack.callback(process.wait, 20)
                stack.callback(process.send_signal, signal.SIGINT)
        got = final_measurements(domain, ("auv_1", "auv_2"))
        logs = "\n".join(file.read_text() for file in tmp_path.glob("*.log"))
        assert set(got) == {"auv_1", "auv_2"}, logs
    assert {v: told.frame for v, told in got.items()} == {v: f"{v}/scene" for v in got}
    assert {v: told.datum.longitude_deg for v, told in got.items()} == {"auv_1": 1.0, "auv_2": 2.0}
    assert {told.verdict for told in got.values()} == {"object"}
