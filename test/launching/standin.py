"""The few actions of `launch` and `launch_ros` that the launch file uses, for where ROS 2 comes from PyPI.

PyPI has neither package. These have the same names, arguments and meaning; where the real ones are installed
the tests use those. What they do not know they refuse: an action's new argument has to be added here.
"""

from __future__ import annotations

import os
import sys
import tempfile
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import yaml


class LaunchContext:
    def __init__(self) -> None:
        self.launch_configurations: dict[str, str] = {}


class Substitution:
    def perform(self, context: LaunchContext) -> str:
        raise NotImplementedError


def perform(value: Any, context: LaunchContext) -> str:
    if isinstance(value, Substitution):
        return value.perform(context)
    if not isinstance(value, str | Path):
        raise TypeError(f"{value!r} is no text and no substitution")
    return str(value)


class LaunchConfiguration(Substitution):
    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self.name]


class PathJoinSubstitution(Substitution):
    def __init__(self, parts: Iterable[Any]) -> None:
        self.parts = list(parts)

    def perform(self, context: LaunchContext) -> str:
        return os.path.join(*(perform(part, context) for part in self.parts))


class FindPackageShare(Substitution):
    def __init__(self, package: str) -> None:
        self.package = package

    def perform(self, context: LaunchContext) -> str:
        from ament_index_python.packages import get_package_share_directory

        return str(get_package_share_directory(self.package))


class ExecutableInPackage(Substitution):
    def __init__(self, executable: str, package: str) -> None:
        self.executable, self.package = executable, package

    def perform(self, context: LaunchContext) -> str:
        return executable_of(self.package, self.executable)


def executable_of(package: str, executable: str) -> str:
    from ament_index_python.packages import get_package_prefix

    place = Path(get_package_prefix(package)) / "lib" / package / executable
    if not os.access(place, os.X_OK):
        raise RuntimeError(f"executable '{executable}' not found on the libexec directory '{place.parent}'")
    return str(place)


class Action:
    condition = None

    def visit(self, context: LaunchContext) -> list[Any] | None:
        return self.execute(context)

    def execute(self, context: LaunchContext) -> list[Any] | None:
        raise NotImplementedError


class DeclareLaunchArgument(Action):
    def __init__(self, name: str, *, default_value: Any, description: str) -> None:
        self.name, self.default_value, self.description = name, default_value, description

    def execute(self, context: LaunchContext) -> None:
        context.launch_configurations.setdefault(self.name, perform(self.default_value, context))


class SetEnvironmentVariable(Action):
    def __init__(self, name: str, value: Any) -> None:
        self.name, self.value = name, value

    def execute(self, context: LaunchContext) -> None:
        os.environ[self.name] = perform(self.value, context)


class OpaqueFunction(Action):
    def __init__(self, *, function: Callable[[LaunchContext], list[Any]]) -> None:
        self.function = function

    def execute(self, context: LaunchContext) -> list[Any]:
        return self.function(context)


class Shutdown(Action):
    def __init__(self, *, reason: str) -> None:
        self.reason = reason


class ExecuteProcess(Action):
    def __init__(
        self,
        *,
        cmd: list[Any],
        output: str = "log",
        sigterm_timeout: str = "5",
        on_exit: Any = None,
        respawn: bool = False,
        respawn_delay: float | None = None,
    ) -> None:
        assert output == "screen"
        self.cmd, self.sigterm_timeout, self.on_exit, self.respawn = cmd, sigterm_timeout, on_exit, respawn

    def command(self, context: LaunchContext) -> list[str]:
        return [perform(part, context) for part in self.cmd]


class Node(ExecuteProcess):
    def __init__(
        self,
        *,
        package: str,
        executable: str,
        name: str,
        namespace: str,
        parameters: list[Any],
        ros_arguments: list[Any],
        **options: Any,
    ) -> None:
        super().__init__(cmd=[], **options)
        self.ros_arguments = ros_arguments
        self.package, self.executable, self.name = package, executable, name
        self.namespace, self.parameters = namespace, parameters

    def command(self, context: LaunchContext) -> list[str]:
        space = f"/{self.namespace.strip('/')}"
        command = [executable_of(self.package, self.executable), "--ros-args"]
        command += [perform(word, context) for word in self.ros_arguments]
        command += ["-r", f"__node:={self.name}", "-r", f"__ns:={space}"]
        for one in self.parameters:
            command += ["--params-file", self._file(one) if isinstance(one, dict) else perform(one, context)]
        return command

    @staticmethod
    def _file(values: dict[str, Any]) -> str:
        with tempfile.NamedTemporaryFile("w", prefix="launch_params_", suffix=".yaml", delete=False) as file:
            yaml.safe_dump({"/**": {"ros__parameters": values}}, file)
        return file.name


class LaunchDescription:
    def __init__(self, entities: list[Any]) -> None:
        self.entities = entities


def install() -> None:
    """Put the stand-ins where the real packages would be."""

    def module(name: str, *members: Any) -> None:
        made = types.ModuleType(name)
        for member in members:
            setattr(made, member.__name__, member)
        sys.modules[name] = made

    module("launch", LaunchDescription, LaunchContext)
    actions = DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, SetEnvironmentVariable, Shutdown
    module("launch.actions", *actions)
    module("launch.substitutions", LaunchConfiguration, PathJoinSubstitution)
    module("launch_ros")
    module("launch_ros.actions", Node)
    module("launch_ros.substitutions", ExecutableInPackage, FindPackageShare)
