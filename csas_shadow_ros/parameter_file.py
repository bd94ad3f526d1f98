"""Parameters from a file in ROS 2's layout, for the pipeline in one process."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from .core.errors import ParameterError
from .core.parameters import STAGES, PipelineParameters


def stage_of_parameter() -> dict[str, str]:
    """Return the stage of each of the core's parameters, by the parameter's name."""
    found: dict[str, str] = {}
    for stage, kind in STAGES.items():
        for field in dataclasses.fields(kind):
            found[field.name] = stage
    return found


def pipeline_parameters(values: Mapping[str, Any]) -> PipelineParameters:
    """Make the pipeline's parameters of values by name; those that are not given have their default.

    Raises
    ------
    ParameterError
        If a name is unknown or a value out of range.
    """
    stages = stage_of_parameter()
    grouped: dict[str, dict[str, Any]] = {stage: {} for stage in STAGES}
    for name, value in values.items():
        if name not in stages:
            raise ParameterError(f"unknown parameter {name!r}; expected one of: {', '.join(sorted(stages))}")
        grouped[stages[name]][name] = value
    sets: dict[str, Any] = {s: kind.from_mapping(grouped[s]) for s, kind in STAGES.items()}
    return PipelineParameters(**sets)


#: Whose section decides where several nodes take a parameter of a stage; the others stand behind it.
_OWNER = {
    "sub_aperture": "sub_aperture",
    "target": "sub_aperture",
    "shadow": "shadow_enhancement",
    "likelihood": "shadow_likelihood",
    "carving": "voxel_carver",
    "place": "voxel_carver",
}


def read_parameter_file(path: str | Path) -> dict[str, Any]:
    """Read the core's parameters from a ROS 2 parameter file.

    What concerns only the nodes (``autostart``, ``window``, ...) is checked and passed over.

    Parameters
    ----------
    path : path-like
        YAML: node name (or ``/**``), ``ros__parameters``, name: value.

    Returns
    -------
    dict
        Values by name.

    Raises
    ------
    ParameterError
        If the file cannot be read or has another layout, a node, a name or a value is not known or out of
        range, or two nodes contradict each other.
    """
    # Here and not above: the nodes' package stands over this one. It needs no ROS either.
    from .nodes.runtime.params import NODES, OF_RCLPY

    try:
        document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ParameterError(f"parameter file {str(path)!r} cannot be read: {error}") from error
    stages = stage_of_parameter()
    every = {field.name for kind in NODES.values() for field in dataclasses.fields(kind)}
    given: dict[str, dict[str, Any]] = {}
    for node, parameters in _sections(document, path):
        if node == "**":
            known = every | set(stages)
        elif node in NODES:
            known = {field.name for field in dataclasses.fields(NODES[node])}
        else:
            raise ParameterError(f"{path}: unknown node {node!r}; expected /** or one of: {', '.join(NODES)}")
        parameters = {k: v for k, v in parameters.items() if not k.startswith(OF_RCLPY)}
        for name, value in parameters.items():
            if name not in known:
                raise ParameterError(
                    f"{path}: {node} has an unknown parameter {name!r}; expected one of:"
                    f" {', '.join(sorted(known))}"
                )
            if name in stages:
                given.setdefault(name, {})[node] = value
        if node in NODES:
            try:
                NODES[node].from_mapping(parameters)
            except ParameterError as error:
                raise ParameterError(f"{path}: {node}: {error}") from error
    return {name: _decide(path, name, stages[name], by_node) for name, by_node in given.items()}


def _decide(path: str | Path, name: str, stage: str, by_node: dict[str, Any]) -> Any:
    """Choose among what several nodes' sections say of one parameter."""
    owner = _OWNER.get(stage, "**")
    if owner not in by_node and "**" in by_node:
        owner = "**"
    if owner not in by_node:
        owner = next(iter(by_node))
    default = STAGES[stage].__dataclass_fields__[name].default
    plain = list(default) if isinstance(default, tuple) else default
    for node, value in by_node.items():
        # A section that still has the default contradicts nobody: the shipped file lists them all.
        if value not in (by_node[owner], plain) and node != "**":
            raise ParameterError(
                f"{path}: {name} is {by_node[owner]!r} for {owner} and {value!r} for {node};"
                " expected one value"
            )
    return by_node[owner]


def _sections(document: Any, path: str | Path) -> list[tuple[str, dict[str, Any]]]:
    layout = f"{path}: expected ROS 2's layout (node name, ros__parameters, name: value)"
    if not isinstance(document, dict):
        raise ParameterError(layout)
    found: list[tuple[str, dict[str, Any]]] = []

    def walk(name: str, section: Any) -> None:
        if not isinstance(section, dict):
            raise ParameterError(f"{layout}; found {name}: {section!r}")
        for key, value in section.items():
            if key == "ros__parameters":
                if not isinstance(value, dict):
                    raise ParameterError(f"{layout}; {name} has {value!r} as ros__parameters")
                found.append((name, value))
            else:  # a namespace
                walk(str(key).rpartition("/")[2], value)

    for key, value in document.items():
        walk(str(key).rpartition("/")[2], value)
    if not found:
        raise ParameterError(layout)
    return found
