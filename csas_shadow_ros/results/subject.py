"""What the figures of a run are drawn of, kept while its views come by."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..core.geometry import CoherentImage, Track, View, wrap_angle
from ..core.parameters import PipelineParameters
from ..core.pipeline import ProcessedView
from ..core.shape.result import Result

if TYPE_CHECKING:
    import trimesh

#: Aspects of the collections of six, degrees.
SIX_ASPECTS_DEG = (20.0, 80.0, 140.0, 200.0, 260.0, 320.0)


@dataclass(eq=False)
class Keeper:
    """Keeps the views that the figures show, of all that come by: those nearest to six aspects."""

    aspects_deg: tuple[float, ...] = SIX_ASPECTS_DEG
    kept: dict[float, tuple[float, ProcessedView]] = field(default_factory=dict)

    def add(self, view: ProcessedView) -> None:
        """Look at one view and keep it if it is the nearest so far to one of the aspects."""
        any_stage = view.shadow or view.sub_aperture or view.likelihood or view.mask
        if any_stage is None:
            return
        for aspect in self.aspects_deg:
            off = abs(float(wrap_angle(any_stage.info.aspect_rad - math.radians(aspect))))
            if off < math.pi / len(self.aspects_deg) and off < self.kept.get(aspect, (math.inf, view))[0]:
                self.kept[aspect] = (off, view)

    def views(self) -> list[ProcessedView]:
        """Return what was kept, in order of aspect."""
        return [self.kept[a][1] for a in self.aspects_deg if a in self.kept]

    def of(self, stage: str) -> list[View]:
        """Return the kept views of one stage."""
        found = (getattr(view, stage) for view in self.views())
        return [view for view in found if view is not None]


@dataclass(frozen=True, eq=False)
class Subject:
    """What the figures are drawn of."""

    result: Result
    keeper: Keeper
    parameters: PipelineParameters
    image: CoherentImage | None = None
    track: Track | None = None
    truth: trimesh.Trimesh | None = None
