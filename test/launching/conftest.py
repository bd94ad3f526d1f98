"""The launch file, and what it starts."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from following import FILE, ROOT, Started, command_of, real_launch

from csas_shadow_ros.nodes.runtime.params import NODES


@pytest.fixture(scope="session")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What colcon would install of this tree."""
    made = tmp_path_factory.mktemp("prefix")
    marker = made / "share/ament_index/resource_index/packages/csas_shadow_ros"
    marker.parent.mkdir(parents=True)
    marker.touch()
    (made / "share/csas_shadow_ros").mkdir()
    for folder in ("config", "launch"):
        (made / "share/csas_shadow_ros" / folder).symlink_to(ROOT / folder)
    (made / "lib/csas_shadow_ros").mkdir(parents=True)
    for node in NODES:
        script = made / "lib/csas_shadow_ros" / node
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m csas_shadow_ros.nodes.{node} "$@"\n')
        script.chmod(0o755)
    line = made / "lib/csas_shadow_ros/csas-shadow"
    line.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m csas_shadow_ros.cli "$@"\n')
    line.chmod(0o755)
    return made


@pytest.fixture
def launched(prefix: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Give a function that follows the launch file with some arguments, up to the processes."""
    before = dict(sys.modules)
    if not real_launch():
        import standin

        standin.install()
    from launch import LaunchContext

    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{prefix}:{os.environ.get('AMENT_PREFIX_PATH', '')}")
    spec = importlib.util.spec_from_file_location("csas_shadow_launch", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def follow(**arguments: str) -> Started:
        command_line = [f"{name}:={value}" for name, value in arguments.items()]
        monkeypatch.setattr(sys, "argv", ["ros2", "launch", "csas_shadow_ros", FILE.name, *command_line])
        environment = dict(os.environ)
        context = LaunchContext()
        context.launch_configurations.update(arguments)
        commands: dict[str, list[str]] = {}
        respawn: dict[str, bool] = {}
        todo = list(module.generate_launch_description().entities)
        try:
            while todo:
                entity = todo.pop(0)
                if hasattr(entity, "cmd"):
                    name = getattr(entity, "executable", None) or getattr(entity, "node_executable", "replay")
                    commands[name] = command_of(entity, context)
                    respawn[name] = bool(
                        getattr(entity, "respawn", getattr(entity, "_ExecuteLocal__respawn", 0))
                    )
                else:
                    todo[:0] = entity.visit(context) or []
            new = {key: value for key, value in os.environ.items() if environment.get(key) != value}
        finally:
            os.environ.clear()
            os.environ.update(environment)
        return Started(commands, new, respawn)

    follow.module = module  # type: ignore[attr-defined]
    yield follow
    for name in set(sys.modules) - set(before):
        if name.split(".")[0] in ("launch", "launch_ros"):
            del sys.modules[name]


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain that is the test's own."""
    from csas_shadow_ros.graph.processes import DomainReservation

    with DomainReservation() as domain_id:
        yield domain_id
