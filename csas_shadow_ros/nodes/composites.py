"""Node `composites`: multi-look and colour-by-aspect images of the circle (section 2)."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any

from numpy.typing import NDArray

from csas_shadow_ros.core.errors import ViewError
from csas_shadow_ros.core.geometry import Acoustics
from csas_shadow_ros.core.imaging.composites import Composites
from csas_shadow_ros.core.warm import warm_composites
from msg_adapters import GroundInfo, Heartbeat, ground_picture_to_msgs, view_from_msgs
from msg_adapters.topics import stream as stream_of

from . import qos
from .runtime.base import INTEGRATED, CsasNode, Inlet, run_node
from .runtime.pace import Growing, source_is_there
from .runtime.runs import RunFollower

_PICTURES = ("multilook", "color_by_aspect")


class CompositesNode(CsasNode):
    """Takes `sub_aperture/*`; publishes `multilook/*` and `color_by_aspect/*`."""

    name = "composites"
    alone = True

    def setup(self) -> None:
        """Make publishers, then the inlet."""
        self.forget()
        self.pictures = {
            name: (
                self.publisher(stream_of(name).info_topic, qos.LATCHED),
                self.publisher(stream_of(name).image_topic, qos.LATCHED),
            )
            for name in _PICTURES
        }
        self.growing = Growing(
            self.publish_result, self.wanted, self.parameters.publish_hz, partial(source_is_there, self)
        )
        self.runs = RunFollower(self, lambda *_: self.inlet.release())
        self.inlet = Inlet(self, "sub_aperture", "sink", self.work, hold=self.runs.hold)
        self.follow_sources()

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_composites()

    def forget(self) -> None:
        """Drop the images."""
        self.run_ns: int | None = None
        self.composites: Composites | None = None
        self.acoustics: Acoustics | None = None
        self.frame = ""

    def keeps_its_state(self) -> bool:
        """Say no: views of another graph may be in the images."""
        return False

    def state_counts(self) -> dict[str, int]:
        """Return the number of views in the images, and whether they are complete."""
        held = len(self.composites.stamps) if self.composites else 0
        complete = hasattr(self, "growing") and self.growing.complete
        return {"views": held, "complete": int(complete)}

    def work(self, image: Any, info: Any) -> str:
        """Add one view; start afresh with the first view of another run."""
        view = view_from_msgs(image, info, "sub_aperture")
        run_ns = self.runs.run_of(view.info.stamp_ns)
        if run_ns is not None and run_ns != self.run_ns:
            if self.run_ns is not None:
                if run_ns < self.run_ns:
                    raise ViewError(
                        f"view stamped {view.info.stamp_ns} ns is of the run of {run_ns} ns; that of"
                        f" {self.run_ns} ns has begun"
                    )
                if self.composites is not None and not self.growing.complete:
                    self.growing.finish()
                self.composites = None
                self.growing.begin_again()
            self.run_ns = run_ns
        if self.composites is None:
            self.composites, self.acoustics = Composites.for_view(view), view.info.acoustics
            self.frame = view.info.frame
        if view.info.frame != self.frame:
            raise ViewError(
                f"view stamped {view.info.stamp_ns} ns is in frame {view.info.frame!r}; expected that of the"
                f" run, {self.frame!r}"
            )
        if self.composites.integrate(view):
            self.growing.changed()
        return INTEGRATED

    def on_source(self, beat: Heartbeat) -> None:
        """Finish once the source says that every view has arrived."""
        if beat.values.get("stream") == "sub_aperture" and self.has_begun(beat):
            self.growing.source_says(self.inlet.instance in beat.values.get("finished_for", "").split())
            self.tick()

    def has_begun(self, beat: Heartbeat) -> bool:
        """Say whether a source speaks of the present run; without a name it speaks of any."""
        name = beat.values.get("run")
        return name is None or self.run_ns is None or name == str(self.run_ns)

    def tick(self) -> None:
        """Publish the changes."""
        before = self.growing.complete
        self.growing.set_rate(self.parameters.publish_hz)
        self.growing.tick(time.monotonic())
        if self.growing.complete and not before:
            self.tell_now()

    def wanted(self) -> bool:
        """Say whether anybody subscribes to unfinished images."""
        return any(image.get_subscription_count() for _, image in self.pictures.values())

    def publish_result(self) -> None:
        """Publish both images in their present state."""
        if self.composites is None or self.acoustics is None:
            return
        newest_ns = max(self.composites.stamps)
        ground = GroundInfo(newest_ns, self.composites.grid, self.acoustics, frame=self.frame)
        pixels: dict[str, NDArray[Any]] = {
            "multilook": self.composites.multilook(),
            "color_by_aspect": self.composites.color_by_aspect(self.parameters.dynamic_range_db),
        }
        for name, (info_publisher, image_publisher) in self.pictures.items():
            image, info = ground_picture_to_msgs(self.messages, pixels[name], ground, name)
            info_publisher.publish(info)
            image_publisher.publish(image)


def main() -> int:
    """Run the node."""
    return run_node(CompositesNode)


if __name__ == "__main__":
    sys.exit(main())
