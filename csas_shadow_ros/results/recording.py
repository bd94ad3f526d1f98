"""The result of a replay through the node graph, as the same results folder."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import view_from_msgs
from msg_adapters.topics import is_result, stream

from ..bags import BagReader
from ..bags.index import BagIndex
from ..bags.pairs import checked_messages
from ..core.errors import CsasError
from ..core.geometry import GroundGrid, View, wrap_angle
from ..core.parameters import PipelineParameters
from ..core.pipeline import ProcessedView
from ..core.shape.result import Result
from .folder import ResultsWriter
from .subject import SIX_ASPECTS_DEG

if TYPE_CHECKING:
    from ..graph.replay import ReplayResult

#: Stages of the views that figures show.
_STAGES = ("sub_aperture", "shadow", "likelihood", "shadow_mask")


@dataclass(eq=False)
class RecordedComposites:
    """The composites that the graph published, where `Composites` is expected."""

    grid: GroundGrid
    pictures: Mapping[str, NDArray[Any]]
    stamps: range  # how many views are in them is known, not which

    def multilook(self) -> NDArray[np.float32]:
        """Return the multi-look amplitude."""
        return np.asarray(self.pictures["multilook"], dtype=np.float32)

    def color_by_aspect(self) -> NDArray[np.uint8]:
        """Return the colour-by-aspect image."""
        return np.asarray(self.pictures["color_by_aspect"], dtype=np.uint8)


def adopt_replay(
    writer: ResultsWriter, replayed: ReplayResult, parameters: PipelineParameters, *, whole: bool
) -> Result:
    """Take what the graph published, and its recording, for the results folder; nothing is computed again.

    Parameters
    ----------
    writer : ResultsWriter
        Takes the recording as its bag, and the views that figures show.
    replayed : ReplayResult
        With a recording.
    parameters : PipelineParameters
        Those of the replay.
    whole : bool
        The recording holds results at their end alone, and is taken as it is.

    Returns
    -------
    Result
    """
    began = time.perf_counter()
    result = replayed.result
    for lost in replayed.rejected:
        if math.isfinite(lost.aspect_deg):
            result.rejected[lost.aspect_deg] = f"{lost.node}: {lost.reason}"
    if replayed.recording is not None:
        recording = replayed.recording
        writer.attempt("views", lambda: _show_views(writer, recording, result, parameters), None)
        writer.adopt_bag(replayed.recording, whole=whole)
    if replayed.composites_grid is not None and {"multilook", "color_by_aspect"} <= set(replayed.composites):
        recorded: Any = RecordedComposites(
            replayed.composites_grid, replayed.composites, range(replayed.composed)
        )
        result.composites = recorded
    result.timings_s = {"replay": replayed.seconds, "adopt": time.perf_counter() - began}
    return result


def _show_views(
    writer: ResultsWriter, recording: Path, result: Result, parameters: PipelineParameters
) -> None:
    """Read the views that figures show: of each stage those nearest to six aspects, and no others."""
    aspects = {stamp: one.aspect_rad for stamp, one in result.evidence.items()}
    stamps = {
        min(aspects, key=lambda stamp: abs(float(wrap_angle(aspects[stamp] - math.radians(wanted)))))
        for wanted in (SIX_ASPECTS_DEG if aspects else ())
    }
    shown: dict[int, dict[str, View]] = {stamp: {} for stamp in stamps}
    with BagReader(recording) as reader:
        index = BagIndex(reader)
        for stage in _STAGES:
            info = reader.topic(stream(stage).info_topic)
            if info is None or not info.count:
                continue
            infos = {}
            for _, message, stamp in checked_messages(reader, stream(stage).info_topic, lambda _: None):
                if stamp in stamps:
                    infos[stamp] = message
            for stamp, read in index.places(stage, set(infos)):
                with contextlib.suppress(CsasError):  # named by the node that refused it
                    shown[stamp][stage] = view_from_msgs(read(), infos[stamp], stage)
    for stages in shown.values():
        if stages:
            writer.show_view(ProcessedView(result.target, parameters, **stages))


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


def copy_recording(recording: Path, target: Any) -> None:
    """Copy a recording into a bag writer as it is; of results that grew, only the last."""
    reader = BagReader(recording)
    for message in reader.messages():
        last = message.number == reader.topics[message.topic].count - 1
        if last or not is_result(message.topic.removeprefix(f"{reader.namespace}/")):
            target.write(message.topic, message.cdr, message.log_time_ns, type_name=message.type_name)
