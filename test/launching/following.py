"""What a launch would start, and how that is found out in either world."""

from __future__ import annotations

import functools
import importlib.util
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "launch" / "csas_shadow.launch.py"


def real_launch() -> bool:
    try:
        return importlib.util.find_spec("launch.actions") is not None and (
            importlib.util.find_spec("launch_ros.actions") is not None
        )
    except ModuleNotFoundError:
        return False


@functools.cache  # a fortieth of a second for each node of each launch
def _sections(text: str) -> dict[str, Any]:
    return dict(yaml.safe_load(text))


@dataclass
class Started:
    """What a launch would start: commands, and what they find in their environment."""

    commands: dict[str, list[str]]
    environment: dict[str, str]
    #: Whether each is started again when it dies.
    respawn: dict[str, bool] = field(default_factory=dict)

    def parameters(self, node: str) -> dict[str, Any]:
        """Return a node's parameters as rcl puts them together: later files win."""
        found: dict[str, Any] = {}
        command = self.commands[node]
        for flag, file in itertools.pairwise(command):
            if flag == "--params-file":
                for name, section in _sections(Path(file).read_text()).items():
                    if name in ("/**", f"/**/{node}") or name.endswith(f"/{node}"):
                        found |= section["ros__parameters"]
        return found

    def told(self) -> object:
        """Return everything that differs between two launches that differ."""
        graph = [key for key in self.environment if key != "CSAS_GRAPH_ID"]
        parts = {}
        for node, command in self.commands.items():
            files = {b for a, b in itertools.pairwise(command) if a == "--params-file"}
            fixed = [word for word in command if word not in files or "launch_params_" not in word]
            parts[node] = (fixed, sorted(self.parameters(node).items(), key=str) if files else None)
        return parts, {key: self.environment[key] for key in sorted(graph)}, self.respawn


def command_of(process: Any, context: Any) -> list[str]:
    """Return the command of a process of either world."""
    if hasattr(process, "command"):
        return list(process.command(context))
    from launch.utilities import perform_substitutions

    if hasattr(process, "_perform_substitutions"):
        process._perform_substitutions(context)
        context.extend_locals({"ros_specific_arguments": ros_arguments(process)})
    return [perform_substitutions(context, part) for part in process.cmd]


def ros_arguments(node: Any) -> dict[str, str]:
    """Return the part of a real node's command that it works out when it is executed."""
    name = node.node_name.rpartition("/")[2]
    return {"name": f"__node:={name}", "ns": f"__ns:={node.expanded_node_namespace}"}


def respawns(process: Any) -> bool:
    """Say whether a process of either world is started again when it dies."""
    return bool(getattr(process, "respawn", getattr(process, "_ExecuteLocal__respawn", False)))
