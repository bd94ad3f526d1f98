"""A run's result to and from messages: complete, to the last digit, without computing again.

`measurements` says what there is, so that a message that is left of an earlier result is not taken for one of
this one; all messages of a result carry one stamp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.shape.result import ObjectResult, Result
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid

from .evidence import evidence_from_msg, evidence_to_msg
from .measurements import (
    GridFacts,
    MeasuredObject,
    measurements_from_msg,
    measurements_to_msg,
    numbered_objects,
)
from .mesh import mesh_from_msg, mesh_to_msg
from .messages import MessageFactory, frame_of, stamp_to_ns
from .objects import objects_to_msg
from .pairs import voxel_grid_from_msgs, voxel_grid_to_msgs
from .search import decision_from_msg
from .topics import OTHER_METHOD, PREFIXED_TOPICS, object_prefix, prefixed, stream
from .voxels import voxels_from_msg, voxels_to_msg

if TYPE_CHECKING:
    import trimesh

#: A voxel of a cloud (float32) lies this close to one of the lattice, in voxels.
_OFF_LATTICE = 0.1


def _all(_: str) -> bool:
    return True


def result_to_msgs(
    factory: MessageFactory,
    result: Result,
    *,
    stamp_ns: int | None = None,
    before: int = 0,
    wanted: Callable[[str], bool] = _all,
) -> Iterator[tuple[str, Any]]:
    """Make the messages of a result, each on demand.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    result : Result
        What the run leaves. Composites, rejected views and timings are not in these messages.
    stamp_ns : int, optional
        Stamp of all of them, ns; that of the newest view in it by default.
    before : int
        Highest number of an object that was published before: those that are gone are taken away.
    wanted : callable
        Whether somebody wants a topic (relative name): grids, voxels and meshes of others are not made.

    Yields
    ------
    (str, message)
        The topic, relative to the namespace, and its message. `measurements` comes last.

    Raises
    ------
    AdapterError
        If something in the result has no place in its message.
    """
    factory = factory.in_frame(result.frame)
    stamp = result.stamp_ns if stamp_ns is None else stamp_ns
    mesh = result.mesh
    yield from _shape(factory, "", result.grid, mesh, stamp, wanted)
    if result.grid is not None and result.matter is not None:
        yield from _voxel_stream(factory, "matter", result.grid.volume, result.matter, stamp, wanted)
    if wanted("matter/mesh"):
        without_hollows = None if result.matter_mesh is mesh else result.matter_mesh
        yield "matter/mesh", mesh_to_msg(factory, without_hollows, stamp)
    objects = numbered_objects(result)
    further = {number: one for number, one in objects.items() if number > 1}
    for number, one in further.items():
        yield from _shape(factory, object_prefix(number), one.grid, one.mesh, stamp, wanted)
    for number in (n for n in range(2, before + 1) if n not in further):
        yield from _shape(factory, object_prefix(number), None, None, stamp, wanted)
    if result.other_grid is not None:
        yield from _grid(factory, OTHER_METHOD, result.other_grid, stamp, wanted)
    yield "objects", objects_to_msg(factory, result, before, stamp)
    yield "evidence", evidence_to_msg(factory, result.evidence, stamp)
    # Last: it tells what there is, and who has it has everything.
    yield "measurements", measurements_to_msg(factory, result, stamp)


def _shape(
    factory: MessageFactory,
    prefix: str,
    grid: VoxelGrid | None,
    mesh: trimesh.Trimesh | None,
    stamp_ns: int,
    wanted: Callable[[str], bool],
) -> Iterator[tuple[str, Any]]:
    yield from _grid(factory, prefix, grid, stamp_ns, wanted)
    if wanted(topic := prefixed(prefix, "mesh")):
        yield topic, mesh_to_msg(factory, mesh, stamp_ns)


def _grid(
    factory: MessageFactory,
    prefix: str,
    grid: VoxelGrid | None,
    stamp_ns: int,
    wanted: Callable[[str], bool],
) -> Iterator[tuple[str, Any]]:
    if grid is not None:
        for name, values in (("voxel_grid", grid.likelihood), ("voxel_views", grid.views)):
            yield from _voxel_stream(factory, prefixed(prefix, name), grid.volume, values, stamp_ns, wanted)
    if wanted(topic := prefixed(prefix, "voxels")):
        yield topic, voxels_to_msg(factory, grid, stamp_ns)


def _voxel_stream(
    factory: MessageFactory,
    name: str,
    volume: Volume,
    values: NDArray[Any],
    stamp_ns: int,
    wanted: Callable[[str], bool],
) -> Iterator[tuple[str, Any]]:
    kind = stream(name)
    topics = [topic for topic in (kind.info_topic, kind.image_topic) if wanted(topic)]
    if topics:
        picture, info = voxel_grid_to_msgs(factory, volume, values, stamp_ns, name)
        made = {kind.info_topic: info, kind.image_topic: picture}
        yield from ((topic, made[topic]) for topic in topics)


def topics_of_result(measurements: Any) -> list[str]:
    """Return the topics needed to rebuild the result of a `measurements` message.

    Raises
    ------
    AdapterError
        See `measurements_from_msg`.
    """
    told = measurements_from_msg(measurements)
    grid = [topic for topic in PREFIXED_TOPICS if topic != "mesh"]
    topics = ["measurements", "objects", "evidence"]
    if told.grid is not None:
        topics += [*grid, "mesh"]
        if told.matter_volume_m3 is not None:
            topics += ["matter/camera_info", "matter/image", "matter/mesh"]
    if told.other_grid is not None:
        topics += [prefixed(OTHER_METHOD, topic) for topic in grid]
    for one in told.objects:
        if one.number > 1:
            topics += [prefixed(object_prefix(one.number), topic) for topic in (*grid, "mesh")]
    return topics


def result_from_msgs(messages: Mapping[str, Any]) -> Result:
    """Rebuild a result from its messages, to the last digit.

    Composites, rejected views and timings are not among them, and stay empty. Vertices of a mesh come in
    another order: a marker holds triangles.

    Parameters
    ----------
    messages : mapping of str to message
        By topic, relative to the namespace; of either message world. Others than a result's are passed over,
        and so are those of a result's topics that `measurements` does not tell of.

    Raises
    ------
    AdapterError
        If one is missing, breaks the contract, or carries another stamp than `measurements`.
    """
    told = measurements_from_msg(_message(messages, "measurements"))
    reader = _Reader(messages, told.stamp_ns, told.frame)
    objects = {one.number: one for one in told.objects}
    main = objects.pop(1, None)
    result = Result(
        run_ns=told.run_ns,
        stamp_ns=told.newest_ns,
        final=told.final,
        verdict=told.verdict,
        quality=told.quality,
        target=told.target,
        sign=told.sign,
        detectable=told.detectable,
        views_used=told.views_used,
        arc_rad=told.arc_rad,
        evidence=evidence_from_msg(reader.stamped("evidence")),
        further=[reader.object(one) for one in objects.values()],
        left_out=list(told.left_out),
        frame=told.frame,
        datum=told.datum,
    )
    if "search" in messages:
        result.decision = decision_from_msg(messages["search"]).decision
    if numbers := [n for i, n in enumerate(objects, start=2) if n != i]:
        raise AdapterError(
            f"measurements has an object {numbers[0]} after {numbers[0] - 2 or 'no'} others;"
            " expected further objects to be numbered 2, 3, ..."
        )
    if told.grid is not None:
        result.grid = reader.grid("", told.grid)
        result.mesh = reader.surface("mesh") if main is None else reader.mesh("")
        if told.matter_volume_m3 is not None:
            result.matter = reader.matter(told.grid)
            without_hollows = reader.surface("matter/mesh")
            result.matter_mesh = result.mesh if without_hollows is None else without_hollows
    if main is not None:
        if result.grid is None:
            raise AdapterError("measurements has an object 1, but its run no grid; expected both or neither")
        result.dimensions = main.dimensions
    if told.other_grid is not None:
        result.other_grid = reader.grid(OTHER_METHOD, told.other_grid)
    return result


def _message(messages: Mapping[str, Any], topic: str) -> Any:
    if topic not in messages:
        raise AdapterError(f"there is no message of {topic}; expected one to rebuild the result from")
    return messages[topic]


class _Reader:
    """Takes a result's parts out of messages of one stamp and frame."""

    def __init__(self, messages: Mapping[str, Any], stamp_ns: int, frame: str) -> None:
        self._frame = frame
        self._messages = messages
        self._stamp_ns = stamp_ns

    def stamped(self, topic: str) -> Any:
        message = _message(self._messages, topic)
        stamp = stamp_to_ns(message.header.stamp, f"{topic}.header.stamp")
        if stamp != self._stamp_ns:
            raise AdapterError(
                f"{topic} is stamped {stamp} ns; expected the stamp of measurements, {self._stamp_ns} ns"
            )
        frame_of(message, topic, self._frame)
        return message

    def values(self, name: str, facts: GridFacts) -> tuple[Volume, NDArray[Any]]:
        """Read an image of voxels on the exact lattice."""
        kind = stream(name)
        image, info = self.stamped(kind.image_topic), self.stamped(kind.info_topic)
        _, volume, values = voxel_grid_from_msgs(image, info, name)
        d = facts.voxel_size_m
        differences = np.subtract(volume.origin_m, facts.origin_m)
        if abs(volume.voxel_size_m - d) > 1e-6 * d or np.abs(differences).max() > 1e-3 * d:
            raise AdapterError(
                f"{kind.info_topic} has voxels of {volume.voxel_size_m:g} m from {volume.origin_m};"
                f" expected those of measurements, {d:g} m from {facts.origin_m}"
            )
        return Volume(facts.origin_m, d, volume.shape), values

    def grid(self, prefix: str, facts: GridFacts) -> VoxelGrid:
        volume, likelihood = self.values(prefixed(prefix, "voxel_grid"), facts)
        name = prefixed(prefix, "voxel_views")
        of_views, views = self.values(name, facts)
        if of_views != volume:
            raise AdapterError(f"{name} has {of_views.shape} voxels (z, y, x); expected {volume.shape}")
        if views.max() > np.iinfo(np.uint16).max or (views != np.rint(views)).any():
            raise AdapterError(f"{name} has up to {views.max():g} views; expected whole numbers below 65536")
        occupied = self.occupied(prefixed(prefix, "voxels"), volume)
        return VoxelGrid(
            volume, likelihood, views.astype(np.uint16), facts.threshold, occupied, facts.method, facts.seabed
        )

    def occupied(self, topic: str, volume: Volume) -> NDArray[np.bool_]:
        """Mark the voxels of a cloud on the lattice."""
        points = voxels_from_msg(self.stamped(topic), topic).points_m.astype(np.float64)
        places = (points - volume.origin_m) / volume.voxel_size_m
        index = np.rint(places).astype(np.int64)
        size = np.array(volume.shape[::-1])
        bad = (np.abs(places - index) > _OFF_LATTICE).any(axis=1) | ((index < 0) | (index >= size)).any(
            axis=1
        )
        if bad.any():
            first = int(bad.argmax())
            raise AdapterError(
                f"{topic} has {int(bad.sum())} of {len(points)} points off the lattice, the first at {first}"
                f" ({points[first].tolist()}); expected centres of the grid's voxels"
            )
        occupied = np.zeros(volume.shape, bool)
        occupied[tuple(index.T[::-1])] = True
        return occupied

    def matter(self, facts: GridFacts) -> NDArray[np.bool_]:
        return self.values("matter", facts)[1].astype(bool, copy=False)

    def mesh(self, prefix: str) -> trimesh.Trimesh:
        """Read an object's surface; an empty one where the marker takes it away."""
        found = self.surface(prefixed(prefix, "mesh"))
        if found is None:
            import trimesh  # late: as in mesh_from_msg

            return trimesh.Trimesh()
        return found

    def surface(self, topic: str) -> trimesh.Trimesh | None:
        return mesh_from_msg(self.stamped(topic), topic)

    def object(self, one: MeasuredObject) -> ObjectResult:
        prefix = object_prefix(one.number)
        mesh = self.mesh(prefix)
        return ObjectResult(one.target, self.grid(prefix, one.grid), mesh, one.dimensions, one.views_used)
