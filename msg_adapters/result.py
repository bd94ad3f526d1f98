"""A run's whole result to and from its topics: the one place that says what is published of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.seabed import SeabedSlope
from csas_shadow_ros.core.shape.result import ObjectResult, Result
from csas_shadow_ros.core.volume import VoxelGrid

from .measurements import (
    GridFacts,
    Measurements,
    evidence_from_msg,
    evidence_to_msg,
    measurements_from_msg,
    measurements_to_msg,
)
from .mesh import mesh_from_msg, mesh_to_msg
from .messages import MessageFactory
from .objects import objects_to_msg
from .pairs import voxel_grid_from_msgs, voxel_grid_to_msgs
from .search import decision_from_msg
from .topics import GRID_TOPICS, OTHER_METHOD, prefixed
from .voxels import voxels_from_msg, voxels_to_msg


def _object(number: int) -> str:
    return f"object_{number}"


def _any(_: str) -> bool:
    return True


def result_to_msgs(
    factory: MessageFactory,
    result: Result,
    *,
    stamp_ns: int,
    wanted: Callable[[str], bool] = _any,
    before: int = 0,
) -> Iterator[tuple[str, Any]]:
    """Turn a result into messages.

    Parameters
    ----------
    factory : MessageFactory
        Makes them.
    result : Result
        What was found.
    stamp_ns : int
        Their stamp.
    wanted : callable
        Says whether anybody wants a topic: large messages for nobody are not made.
    before : int
        How many further objects were published last: those that are gone are taken away.

    Yields
    ------
    (str, message)
        Relative topic and message; `measurements` last, when everything that it tells of is out.
    """
    if result.grid is not None:
        yield from _grid_to_msgs(factory, "", result.grid, stamp_ns, wanted)
    if result.matter is not None and result.grid is not None and wanted("matter/image"):
        matter = result.matter.astype(np.float32)
        image, info = voxel_grid_to_msgs(factory, result.grid.volume, matter, stamp_ns, "matter")
        yield from (("matter/camera_info", info), ("matter/image", image))
    bared = None if result.matter_mesh is result.mesh else result.matter_mesh
    meshes = {"mesh": result.mesh, "matter/mesh": bared}
    for number, one in enumerate(result.further, start=2):
        name = _object(number)
        yield from _grid_to_msgs(factory, name, one.grid, stamp_ns, wanted)
        meshes[prefixed(name, "mesh")] = one.mesh
    if result.other_grid is not None:
        yield from _grid_to_msgs(factory, OTHER_METHOD, result.other_grid, stamp_ns, wanted)
    for number in range(len(result.further) + 2, before + 2):
        meshes[prefixed(_object(number), "mesh")] = None
    for topic, mesh in meshes.items():
        # A mesh of ten thousand triangles takes longer to write as a message than to carve from a view.
        if mesh is None or wanted(topic):
            yield topic, mesh_to_msg(factory, mesh, stamp_ns)
    yield "objects", objects_to_msg(factory, result, stamp_ns, before + 1)
    if wanted("evidence"):
        yield "evidence", evidence_to_msg(factory, result.evidence, stamp_ns)
    yield "measurements", measurements_to_msg(factory, result, stamp_ns)


def _grid_to_msgs(
    factory: MessageFactory, prefix: str, grid: VoxelGrid, stamp_ns: int, wanted: Callable[[str], bool]
) -> Iterator[tuple[str, Any]]:
    for name, values in (("voxel_grid", grid.likelihood), ("voxel_views", grid.views)):
        topic = prefixed(prefix, name)
        if wanted(f"{topic}/image") or wanted(f"{topic}/camera_info"):
            image, info = voxel_grid_to_msgs(factory, grid.volume, values, stamp_ns, name)
            yield from ((f"{topic}/camera_info", info), (f"{topic}/image", image))
    if wanted(prefixed(prefix, "voxels")):
        yield prefixed(prefix, "voxels"), voxels_to_msg(factory, grid, stamp_ns)


def topics_of_result(measurements: Any) -> list[str]:
    """Return the topics of the result that a message of `measurements` speaks of.

    Raises
    ------
    AdapterError
        See `measurements_from_msg`.
    """
    told = measurements_from_msg(measurements)
    topics = ["measurements", "objects", "mesh", "evidence"]
    if told.main is not None:
        topics += [t for t in GRID_TOPICS if t != "mesh"]
    if told.hollow is not None:
        topics += ["matter/camera_info", "matter/image", "matter/mesh"]
    if told.other is not None:
        topics += [prefixed(OTHER_METHOD, t) for t in GRID_TOPICS if t != "mesh"]
    for number in range(2, 2 + len(told.objects) - _main_is_object(told)):
        topics += [prefixed(_object(number), t) for t in GRID_TOPICS]
    return topics


def _main_is_object(told: Measurements) -> bool:
    """Say whether the first object is the target: its grid is that of the topics without a prefix."""
    return bool(told.objects) and told.main is not None and told.objects[0].grid == told.main


def result_from_msgs(messages: Mapping[str, Any]) -> Result:
    """Put a result together from its messages, by relative topic: nothing is computed.

    What no message tells is empty: `sides`, `looks`, `composites`, `rejected` and `timings_s`.

    Raises
    ------
    AdapterError
        If a message is missing, breaks the contract, or contradicts another.
    """
    told = measurements_from_msg(_message(messages, "measurements"))
    result = Result(
        run_ns=told.run_ns,
        stamp_ns=told.stamp_ns,
        final=told.final,
        verdict=told.verdict,
        quality=told.quality,
        target=told.target,
        sign=told.sign,
        views_used=told.views_used,
        arc_rad=told.arc_rad,
        left_out=list(told.left_out),
    )
    if "search" in messages:
        result.decision = decision_from_msg(messages["search"]).decision
    if "evidence" in messages:
        result.evidence = evidence_from_msg(messages["evidence"])
    if told.main is not None:
        result.grid = _grid_from_msgs(messages, "", told.main, told.slope)
    if told.other is not None:
        result.other_grid = _grid_from_msgs(messages, OTHER_METHOD, told.other)
    main = _main_is_object(told)
    if main:
        result.mesh = mesh_from_msg(_message(messages, "mesh"))
        result.dimensions = told.objects[0].dimensions
    if told.hollow is not None and result.grid is not None:
        image, info = _message(messages, "matter/image"), _message(messages, "matter/camera_info")
        result.matter = voxel_grid_from_msgs(image, info, "matter")[2] > 0.5
        result.matter_mesh = mesh_from_msg(_message(messages, "matter/mesh")) if told.hollow else result.mesh
    for number, one in enumerate(told.objects[1:] if main else told.objects, start=2):
        prefix = _object(number)
        grid = _grid_from_msgs(messages, prefix, one.grid)
        mesh = mesh_from_msg(_message(messages, prefixed(prefix, "mesh")))
        if mesh is None:
            raise AdapterError(
                f"{prefixed(prefix, 'mesh')} takes the surface away; measurements tell of an object"
            )
        result.further.append(ObjectResult(one.target, grid, mesh, one.dimensions, one.grid.views))
    return result


def _message(messages: Mapping[str, Any], topic: str) -> Any:
    try:
        return messages[topic]
    except KeyError:
        raise AdapterError(f"no message of {topic} is there; measurements tell of one") from None


def _grid_from_msgs(
    messages: Mapping[str, Any], prefix: str, facts: GridFacts, slope: SeabedSlope | None = None
) -> VoxelGrid:
    """Put a grid together: its lattice to the last digit from `facts`, its object's voxels from `voxels`."""
    volume = facts.volume
    values = {}
    for name in ("voxel_grid", "voxel_views"):
        topic = prefixed(prefix, name)
        image, info = _message(messages, f"{topic}/image"), _message(messages, f"{topic}/camera_info")
        _, own, values[name] = voxel_grid_from_msgs(image, info, name)
        off = np.abs(np.subtract(own.origin_m, volume.origin_m)).max()
        if own.shape != volume.shape or off > 1e-3 * volume.voxel_size_m:
            raise AdapterError(f"{topic}/camera_info has the lattice {own}; measurements say {volume}")
    cloud = voxels_from_msg(_message(messages, prefixed(prefix, "voxels")))
    at = np.rint((cloud.points_m - np.asarray(volume.origin_m)) / volume.voxel_size_m).astype(np.intp)
    if len(at) and (at.min() < 0 or (at.max(axis=0) >= volume.shape[::-1]).any()):
        raise AdapterError(f"{prefixed(prefix, 'voxels')} lie outside of the lattice {volume}")
    occupied = np.zeros(volume.shape, bool)
    occupied[at[:, 2], at[:, 1], at[:, 0]] = True
    views = values["voxel_views"].astype(np.uint16)
    return VoxelGrid(volume, values["voxel_grid"], views, facts.threshold, occupied, facts.method, slope)
