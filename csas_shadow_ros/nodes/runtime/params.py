"""Parameters of the nodes: the core's dataclasses, plus those that only a node needs.

One dataclass a node drives its ROS parameter descriptors, ``config/csas_shadow.yaml`` and the table of
docs/parameters.md; a test holds the three together. ``python -m csas_shadow_ros.nodes.runtime.params`` prints
the table, with ``--yaml`` the YAML file.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.methods import METHODS
from csas_shadow_ros.core.parameters import (
    MAX_OBJECTS,
    MOST_OBJECTS,
    CarvingParameters,
    LikelihoodParameters,
    Parameters,
    PlaceParameters,
    ShadowParameters,
    SubApertureParameters,
    TargetParameters,
    bounded,
)

P = TypeVar("P", bound=Parameters)


@dataclass(frozen=True)
class NodeParameters(Parameters):
    """Parameters of every node."""

    autostart: bool = bounded(True, "configure and activate on start; false: wait for a lifecycle manager")
    scene_frame: str = bounded("", "accept only messages in this frame; empty: any single frame")


@dataclass(frozen=True)
class FlowParameters(Parameters):
    """Parameters of every source of views."""

    window: int = bounded(4, "keep at most this many views in flight", low=1, high=8)
    resend_s: float = bounded(
        5.0, "resend a view if unacknowledged for this long", low=0.1, high=600.0, unit="s"
    )
    sink_wait_s: float = bounded(
        60.0, "wait this long for a missing consumer", low=0.0, high=86400.0, unit="s"
    )
    min_sinks: int = bounded(0, "wait for this many sinks before sending the first view", low=0, high=16)


@dataclass(frozen=True)
class SnapshotParameters(Parameters):
    """Parameters of nodes that publish a growing result."""

    publish_hz: float = bounded(
        1.0,
        "publish an unfinished result at most this often; 0: publish only the final one",
        low=0.0,
        high=20.0,
        unit="Hz",
    )


@dataclass(frozen=True)
class FocusParameters(Parameters):
    """Parameters of the focus of shadows."""

    target: str = bounded(
        "auto",
        "take the target from topic target (auto) or from position_m (given)",
        choices=("auto", "given"),
    )
    position_m: tuple[float, ...] = bounded(
        (0.0, 0.0), "set x, y of a given target", low=-1e6, high=1e6, unit="m", length=2
    )


@dataclass(frozen=True)
class BoxParameters(Parameters):
    """Position and size of the target, for nodes behind the one that finds it."""

    target: str = bounded(
        "auto",
        "take the target from topic target (auto) or from position_m and size_m (given)",
        choices=("auto", "given"),
    )
    position_m: tuple[float, ...] = bounded(
        (0.0, 0.0), "set x, y of a given target", low=-1e6, high=1e6, unit="m", length=2
    )
    size_m: tuple[float, ...] = bounded(
        (0.0, 0.0, 0.0), "set the x, y, z size of a given volume", low=0.0, high=1e5, unit="m", length=3
    )


@dataclass(frozen=True)
class SubApertureNodeParameters(NodeParameters, FlowParameters, TargetParameters, SubApertureParameters):
    """Parameters of `sub_aperture`."""

    first_search_deg: float = bounded(
        120.0,
        "search for a target once sectors cover this arc; 360: wait for the closed circle",
        low=30.0,
        high=360.0,
        unit="deg",
    )
    max_objects: int = bounded(
        MAX_OBJECTS, "carve at most this many bodies, including the target", low=1, high=MOST_OBJECTS
    )


@dataclass(frozen=True)
class ShadowEnhancementNodeParameters(NodeParameters, FocusParameters, ShadowParameters):
    """Parameters of `shadow_enhancement`."""


@dataclass(frozen=True)
class ShadowLikelihoodNodeParameters(NodeParameters, BoxParameters, LikelihoodParameters):
    """Parameters of `shadow_likelihood`."""


@dataclass(frozen=True)
class VoxelCarverNodeParameters(
    NodeParameters,
    SnapshotParameters,
    BoxParameters,
    ShadowParameters,
    LikelihoodParameters,
    CarvingParameters,
    PlaceParameters,
):
    """Parameters of `voxel_carver`; those of earlier stages measure the target and carve further bodies."""

    parent_frame: str = bounded(
        "earth",
        "publish scene_transform into this frame: earth (REP 105) or an east-north-up one, such as map",
    )
    parent_lat_deg: float = bounded(
        math.nan,
        "set the latitude of that frame's origin; none: the scene's",
        low=-90.0,
        high=90.0,
        unit="deg",
        optional=True,
    )
    parent_lon_deg: float = bounded(
        math.nan,
        "set the longitude of that frame's origin",
        low=-180.0,
        high=360.0,
        unit="deg",
        optional=True,
    )
    compare: bool = bounded(
        True, "also carve by the other method, on other_method/*, to find objects too thin for silhouettes"
    )

    def check(self) -> None:
        """Refuse a latitude without a longitude, or the reverse."""
        super().check()
        if math.isnan(self.parent_lat_deg) != math.isnan(self.parent_lon_deg):
            raise ParameterError("only one of parent_lat_deg, parent_lon_deg is given; expected both or none")


@dataclass(frozen=True)
class CompositesNodeParameters(NodeParameters, SnapshotParameters):
    """Parameters of `composites`."""

    dynamic_range_db: float = bounded(
        35.0, "show this range of levels in colour by aspect", low=1.0, high=200.0, unit="dB"
    )


@dataclass(frozen=True)
class BagPlayerNodeParameters(NodeParameters, FlowParameters):
    """Parameters of `bag_player`."""

    bag: str = bounded("", "play this bag: a rosbag2 directory, or an .mcap or .db3 file")
    bag_namespace: str = bounded("", "read the bag's topics in this namespace; empty: detect it")
    stage: str = bounded(
        "auto",
        "play this stage; auto: the earliest that is complete in the bag",
        choices=("auto", "image", "sector", "sub_aperture", "shadow", "likelihood", "shadow_mask"),
    )
    run: int = bounded(
        0,
        "play this run of the bag: number from 1, or name (stamp of its first pose, ns); 0: the first",
        low=0,
        high=1 << 62,
    )
    rate: float = bounded(
        1.0,
        "play views at this multiple of the recorded speed; 0: as fast as consumers take them",
        low=0.0,
        high=1e6,
    )
    clock_hz: float = bounded(
        0.0,
        "publish /clock, the recording's time, at this rate; 0: do not",
        low=0.0,
        high=1000.0,
        unit="Hz",
    )


@dataclass(frozen=True)
class BagRecorderNodeParameters(NodeParameters):
    """Parameters of `bag_recorder`."""

    out: str = bounded("", "record to this new directory")
    resume: bool = bounded(False, "continue an existing recording instead of refusing it")
    compress: bool = bounded(True, "compress the bag")
    compression: str = bounded(
        "zstd", "compress by zstd, or by lz4: a tenth larger, four times as fast", choices=("zstd", "lz4")
    )
    sync: bool = bounded(True, "sync a finished bag to the disk, to survive a power cut")
    topics: str = bounded("all", "record these topics, relative, comma-separated; all: the whole contract")


@dataclass(frozen=True)
class ViewerNodeParameters(NodeParameters):
    """Parameters of `viewer`."""

    host: str = bounded("127.0.0.1", "listen at this address; one that is not loopback requires a token")
    port: int = bounded(8765, "serve the page on this port; 0: any free port", low=0, high=65535)
    token: str = bounded("auto", "ask for this token; auto: none on this machine, a new one on a network")
    method: str = bounded(
        "consensus", "show the grid of voxel_carver's method", choices=tuple(METHODS)
    )


#: The parameters of each node.
NODES: dict[str, type[Parameters]] = {
    "sub_aperture": SubApertureNodeParameters,
    "shadow_enhancement": ShadowEnhancementNodeParameters,
    "shadow_likelihood": ShadowLikelihoodNodeParameters,
    "voxel_carver": VoxelCarverNodeParameters,
    "composites": CompositesNodeParameters,
    "bag_player": BagPlayerNodeParameters,
    "bag_recorder": BagRecorderNodeParameters,
    "viewer": ViewerNodeParameters,
}

#: Parameters that may change while the node runs. A change of any other would mix two results in one.
DYNAMIC = frozenset({"window", "resend_s", "sink_wait_s", "publish_hz", "dynamic_range_db", "rate"})

#: Parameters without which their node cannot start.
REQUIRED = frozenset({"bag", "out"})

#: Overrides that belong to rclpy itself.
OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides.")


def part(parameters: Parameters, kind: type[P]) -> P:
    """Return the part of a node's parameters that a function of the core takes."""
    return kind(**{f.name: getattr(parameters, f.name) for f in dataclasses.fields(kind)})


def from_overrides(kind: type[P], overrides: Mapping[str, Any]) -> P:
    """Make a node's parameters from command-line or file values.

    Raises
    ------
    ParameterError
        If a name is unknown or a value out of range.
    """
    return kind.from_mapping({k: v for k, v in overrides.items() if not k.startswith(OF_RCLPY)})


def expected_of(field: dataclasses.Field[Any]) -> str:
    """Say which values a field accepts."""
    meta = field.metadata
    if meta["choices"]:
        return ", ".join(meta["choices"])
    if isinstance(field.default, bool):
        return "true, false"
    if meta["low"] is None:
        return "text"
    each = " each" if meta["length"] else ""
    none = "; nan: none" if meta["optional"] else ""
    return f"{meta['low']:g} to {meta['high']:g}{each}{none}"


def description_of(field: dataclasses.Field[Any]) -> str:
    """Return a field's description with its unit."""
    unit = field.metadata["unit"]
    return str(field.metadata["doc"]) + (f" [{unit}]" if unit else "")


def declare(node: Any, parameters: Parameters) -> None:
    """Declare a node's parameters with descriptors of their bounds.

    Parameters
    ----------
    node : rclpy.node.Node
        The node.
    parameters : Parameters
        Checked values; overrides have been taken into account already.
    """
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    for field in dataclasses.fields(parameters):
        meta = field.metadata
        descriptor = ParameterDescriptor(
            name=field.name,
            description=description_of(field),
            additional_constraints=expected_of(field)
            + ("" if field.name in DYNAMIC else "; set while the node is unconfigured"),
        )
        if meta["optional"]:
            pass  # rclpy finds that NaN is out of any range; `_on_set_parameters` checks it
        elif isinstance(field.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(meta["low"]), to_value=float(meta["high"]), step=0.0)
            ]
        elif isinstance(field.default, int) and not isinstance(field.default, bool):
            descriptor.integer_range = [
                IntegerRange(from_value=int(meta["low"]), to_value=int(meta["high"]), step=1)
            ]
        value = getattr(parameters, field.name)
        if isinstance(value, tuple):
            value = list(value)
        node.declare_parameter(field.name, value, descriptor, ignore_override=True)


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return f"[{', '.join(_yaml_value(v) for v in value)}]"
    if isinstance(value, float):
        # rcl reads a number without a point as an integer, and YAML 1.1 reads 1e-05 as a text.
        if math.isnan(value):
            return ".nan"
        text = repr(value)
        return text if "." in text else text.replace("e", ".0e")
    return str(value)


def yaml_text(values: Mapping[str, Mapping[str, Any]] | None = None, *, only_given: bool = False) -> str:
    """Write parameters as a ROS parameter file.

    Parameters
    ----------
    values : mapping of node name to mapping of parameter name to value
        Values that differ from the defaults.
    only_given : bool
        Write these alone, without comments.
    """
    given = values or {}
    lines = []
    if not only_given:
        lines += [
            "# Parameters of all nodes, with their defaults. Written by",
            "# python -m csas_shadow_ros.nodes.runtime.params --yaml; a test compares. Nodes refuse others.",
        ]
    for name, kind in NODES.items():
        own = given.get(name, {})
        if only_given and not own:
            continue
        lines += [f"/**/{name}:", "  ros__parameters:"]
        parameters = kind.from_mapping(own)
        for field in dataclasses.fields(parameters):
            if only_given and field.name not in own:
                continue
            note = "" if only_given else f"  # {description_of(field)} ({expected_of(field)})"
            lines.append(f"    {field.name}: {_yaml_value(getattr(parameters, field.name))}{note}")
    return "\n".join(lines) + "\n"


def parameter_table() -> str:
    """Write all nodes' parameters as markdown tables, for the README."""
    lines = []
    for name, kind in NODES.items():
        lines += [f"**{name}**", "", "| parameter | default | range | meaning |", "|---|---|---|---|"]
        for field in dataclasses.fields(kind):
            default = _yaml_value(field.default)
            if field.name in REQUIRED:
                default = default.replace('""', '"" (must be given)')
            lines.append(f"| `{field.name}` | {default} | {expected_of(field)} | {description_of(field)} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def check(values: Mapping[str, Mapping[str, Any]]) -> None:
    """Check parameters of several nodes at once.

    Raises
    ------
    ParameterError
        If a node, a name or a value is not known or out of range.
    """
    for name, own in values.items():
        if name not in NODES:
            raise ParameterError(f"unknown node {name!r}; expected one of: {', '.join(NODES)}")
        try:
            NODES[name].from_mapping(own)
        except ParameterError as error:
            raise ParameterError(f"{name}: {error}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, or the YAML file with ``--yaml``."""
    chosen = sys.argv[1:] if arguments is None else list(arguments)
    sys.stdout.write(yaml_text() if "--yaml" in chosen else parameter_table())
    return 0


if __name__ == "__main__":
    sys.exit(main())
