"""The result of a replay through the node graph, as the same results folder."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..bags import BagReader, Run, read_run
from ..core.carving import Carver, KeptMask
from ..core.errors import ViewError
from ..core.geometry import GroundGrid, View
from ..core.hollows import EchoLook
from ..core.likelihood import view_levels
from ..core.measurement import levels_of_mask, measure_object, silhouette_sides
from ..core.parameters import PipelineParameters
from ..core.pipeline import Result, open_hollows
from ..core.segmentation import require_silhouette
from ..core.stages import StagedView, spread_views
from .folder import ResultsWriter
from .subject import SIX_ASPECTS_DEG

if TYPE_CHECKING:
    from ..replay import ReplayResult

#: Masks before the views that they were segmented in.
_STAGES = {
    "sub_aperture": "sub_aperture",
    "shadow_mask": "mask",
    "shadow": "shadow",
    "likelihood": "likelihood",
}


@dataclass(eq=False)
class RecordedComposites:
    """The composites that the graph published, where `Composites` is expected."""

    grid: GroundGrid
    pictures: Mapping[str, NDArray[Any]]
    stamps: set[int] = field(default_factory=set)

    def multilook(self) -> NDArray[np.float32]:
        """Return the multi-look amplitude."""
        return np.asarray(self.pictures["multilook"], dtype=np.float32)

    def color_by_aspect(self) -> NDArray[np.uint8]:
        """Return the colour-by-aspect image."""
        return np.asarray(self.pictures["color_by_aspect"], dtype=np.uint8)


def adopt_replay(writer: ResultsWriter, replayed: ReplayResult, parameters: PipelineParameters) -> Result:
    """Turn what a replay left, and its recording, into what the in-process pipeline would have left.

    The grid, mesh, target and composites are the graph's own. The other method's grid (figure 8) is
    carved from the recorded views, and hollows are told from their echoes.

    Parameters
    ----------
    writer : ResultsWriter
        Takes the recording as its bag, and the views that figures show.
    replayed : ReplayResult
        With a recording.
    parameters : PipelineParameters
        Those of the replay.

    Returns
    -------
    Result
    """
    result = Result(
        target=replayed.target,
        grid=replayed.grid,
        mesh=replayed.mesh,
        dimensions=replayed.dimensions,
        views_used=replayed.views_used,
    )
    for lost in replayed.rejected:
        if math.isfinite(lost.aspect_deg):
            result.rejected[lost.aspect_deg] = f"{lost.node}: {lost.reason}"
    began = time.perf_counter()
    if replayed.recording is not None:
        run = read_run(replayed.recording)
        writer.adopt_bag(replayed.recording)
        if replayed.grid is not None:
            _adopt_views(writer, run, result, parameters)
        stamps = _stamps(run, "sub_aperture")
    else:
        stamps = set()
    if replayed.composites_grid is not None and {"multilook", "color_by_aspect"} <= set(replayed.composites):
        recorded: Any = RecordedComposites(replayed.composites_grid, replayed.composites, stamps)
        result.composites = recorded
    result.timings_s = {"replay": replayed.seconds, "adopt": time.perf_counter() - began}
    return result


def _stamps(run: Run, stage: str) -> set[int]:
    return {view.info.stamp_ns for view in run.views(stage)} if run.counts.get(stage) else set()


def _adopt_views(writer: ResultsWriter, run: Run, result: Result, p: PipelineParameters) -> None:
    """Read the recorded views once by stage: levels, the other method's grid, and what the figures show."""
    if result.grid is None:
        return
    held = [stage for stage in _STAGES if run.counts.get(stage)]
    masks: dict[int, KeptMask] = {}
    other = Carver(result.grid.volume, p.carving.other())
    wanted = "shadow_mask" if other.parameters.takes_masks else "likelihood"
    shown: dict[int, dict[str, View]] = {}
    # Of the stage that says most of where a view looked, six; of the others, the same six.
    first = "shadow" if "shadow" in held else held[0]
    start = math.radians(SIX_ASPECTS_DEG[0])
    for view in spread_views(run.views(first), len(SIX_ASPECTS_DEG), start):
        shown[view.info.stamp_ns] = {}
    for stage in held:
        for view in run.views(stage):
            stamp = view.info.stamp_ns
            if stamp in shown:
                shown[stamp][_STAGES[stage]] = view
            try:
                if stage == wanted:
                    other.integrate(require_silhouette(view) if stage == "shadow_mask" else view)
                if stage == "shadow_mask":
                    masks[stamp] = KeptMask.of(view)
                if stage == "shadow":
                    levels = view_levels(view, p.likelihood)
                    result.levels[stamp] = (levels.seabed_level, levels.contrast, levels.estimated)
                    result.looks[stamp] = EchoLook.of(levels, view.info, result.grid.volume)
                    if result.target is not None and stamp in masks:
                        mask = masks.pop(stamp).view()
                        sides = silhouette_sides(levels, mask, result.target.position_m)
                        result.sides += [sides] if sides is not None else []
            except ViewError:
                continue  # named by the node that refused it
            writer.note_view(view)
    for stages in shown.values():
        shadow = stages.get("shadow")
        levels_of = view_levels(shadow, p.likelihood) if shadow is not None else None
        writer.show_view(
            StagedView(
                stages.get("sub_aperture"),
                shadow,
                levels_of,
                stages.get("likelihood"),
                stages.get("mask"),
            )
        )
    if other.stamps:
        result.other_grid = other.grid()
    if result.target is not None:
        for kept in masks.values():  # silhouettes that came without the views that they are of
            mask = kept.view()
            sides = silhouette_sides(levels_of_mask(mask), mask, result.target.position_m)
            result.sides += [sides] if sides is not None else []
    if result.mesh is not None:
        result.dimensions = measure_object(result.grid, result.mesh, result.sides)
    open_hollows(result)


def node_table(replayed: ReplayResult) -> dict[str, Any]:
    """Return what each node says of its part, for the report."""
    return {name: dataclasses.asdict(report) for name, report in replayed.nodes.items()}


def unplaced(replayed: ReplayResult) -> list[str]:
    """Return one line for each view that was refused without its aspect being known."""
    return [
        f"{view.node} refused the view stamped {view.stamp_ns} ns: {view.reason}"
        for view in replayed.rejected
        if not math.isfinite(view.aspect_deg)
    ]


def is_snapshot(reader: BagReader, topic: str) -> bool:
    """Say whether a recorded topic is a result that was published again and again as it grew."""
    relative = topic.removeprefix(f"{reader.namespace}/")
    stream = relative.partition("/")[0]
    return stream in ("voxel_grid", "voxel_views", "voxels", "mesh", "multilook", "color_by_aspect")


def copy_recording(recording: Path, target: Any) -> None:
    """Copy a recording into a bag writer as it is; of results that grew, only the last."""
    reader = BagReader(recording)
    for message in reader.messages():
        last = message.number == reader.topics[message.topic].count - 1
        if last or not is_snapshot(reader, message.topic):
            target.write(message.topic, message.cdr, message.log_time_ns, type_name=message.type_name)
