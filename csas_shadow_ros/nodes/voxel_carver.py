"""Node `voxel_carver`: carves the voxel grid, measures and publishes it (section 4)."""

from __future__ import annotations

import math
import sys
import time
from functools import partial
from typing import Any

from rclpy.publisher import Publisher

from csas_shadow_ros.core.errors import NoTargetError, ParameterError, ViewError
from csas_shadow_ros.core.geometry import looks_at
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    LikelihoodParameters,
    PipelineParameters,
    ShadowParameters,
)
from csas_shadow_ros.core.pipeline import ProcessedView, process
from csas_shadow_ros.core.reconstruction import Reconstruction
from csas_shadow_ros.core.shape.result import Result
from csas_shadow_ros.core.warm import warm_carving
from msg_adapters import Heartbeat, result_to_msgs, view_from_msgs
from msg_adapters.measurements import numbered_objects
from msg_adapters.topics import OTHER_METHOD, PREFIXED_TOPICS, RESULT_TOPICS, object_prefix, prefixed

from . import qos
from .runtime.base import INTEGRATED, CsasNode, Inlet, TargetInlet, run_node
from .runtime.pace import Growing, source_is_there
from .runtime.params import part
from .runtime.place import PlaceOnEarth
from .runtime.runs import RunFollower

#: What of a view each stream brings for the target.
_PARTS = {"shadow_mask": ("mask",), "likelihood": ("likelihood",), "shadow": ("levels", "look")}


class VoxelCarverNode(CsasNode):
    """Takes `shadow_mask/*` (soft: `likelihood/*`) and `shadow/*`; publishes the whole result.

    It carves by the one, and measures against the other: where a silhouette ends to a fraction of a pixel,
    and which hollows no shadow shows. Where nobody publishes `shadow/*`, silhouettes are all that it goes by.
    Further bodies it makes from `sub_aperture/*`, since the views behind it are focused on the target.
    """

    name = "voxel_carver"
    alone = True

    def setup(self) -> None:
        """Make publishers, then the inlets of the method's streams."""
        p = self.parameters
        if p.target == "given" and not all(s > 0 for s in p.size_m):
            raise ParameterError(f"size_m is {list(p.size_m)}; expected x, y, z > 0 m with a given target")
        self.forget()
        self.outlets: dict[str, Publisher] = {}
        for name in RESULT_TOPICS:
            self.outlet(name)
        if p.compare:
            self.open_outlets(OTHER_METHOD)
        self.pipeline = PipelineParameters(
            carving=part(p, CarvingParameters),
            likelihood=part(p, LikelihoodParameters),
            shadow=part(p, ShadowParameters),
        )
        self.growing = Growing(
            self.publish_result, self.wanted, p.publish_hz, partial(source_is_there, self)
        )
        self.runs = RunFollower(self, lambda *_: self.release())
        self.target = TargetInlet(self, self.on_target, self.begin_again)
        self.place = PlaceOnEarth(self, self.on_place)
        self.stream = "shadow_mask" if p.takes_masks else "likelihood"
        self.inlet = self.inlet_of(self.stream)
        # Without silhouettes the soft method has nothing to measure on.
        beside = ["shadow", *(["likelihood"] if p.compare and p.takes_masks else [])]
        for stream in [*beside, *([] if p.takes_masks else ["shadow_mask"])]:
            self.inlet_of(stream, optional=True)
        self.further: Inlet | None = None
        self.follow_sources()
        # More often than a node's own tick: a sector's last view is to be shown at once.
        self.every(0.02, self.show)

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_carving()

    def forget(self) -> None:
        """Drop the run."""
        self.reconstruction: Reconstruction | None = None
        self.result: Result | None = None
        #: Highest number of an object that was published.
        self.highest = 0

    def inlet_of(self, stream: str, *, optional: bool = False) -> Inlet:
        """Make the inlet of a stream."""
        return Inlet(self, stream, "sink", partial(self.work, stream), hold=self.hold, optional=optional)

    def outlet(self, name: str) -> Publisher:
        """Return the publisher of a topic of the result, made on demand for a further object."""
        if name not in self.outlets:
            self.outlets[name] = self.publisher(name, qos.LATCHED)
        return self.outlets[name]

    def open_outlets(self, prefix: str) -> None:
        """Make the publishers of another grid early, so that recorders find them in time."""
        for name in PREFIXED_TOPICS:
            self.outlet(prefixed(prefix, name))

    # Which target, and which run

    def hold(self, stamp: int) -> tuple[str, float]:
        """Let views wait until their run and target are known."""
        reason = self.target.missing()
        return (reason, math.inf) if reason else self.runs.hold(stamp)

    def release(self) -> None:
        """Process views that have waited."""
        for inlet in list(self.inlets):
            inlet.release()

    def on_target(self) -> None:
        """Subscribe to views for further bodies, if there are any."""
        wanted = bool(self.target.decision.others)
        for number in range(2, len(self.target.decision.others) + 2):
            self.open_outlets(object_prefix(number))
        if wanted and self.further is None:
            self.further = self.inlet_of("sub_aperture", optional=True)
            self.tell_now()
        elif not wanted and self.further is not None:
            self.further.close()
            self.further = None
        if self.target.decision.frame is not None:
            run_ns = self.target.run_ns
            self.place.publish(self.target.decision.frame, run_ns, self.runs.last_of(run_ns))
        self.release()

    def on_place(self) -> None:
        """Publish the result again if its place may have changed."""
        if self.result is not None:
            self.growing.changed()

    def begin_again(self, *, another_run: bool) -> None:
        """Drop the state of a moved target; for a finished run, publish the final result first."""
        if another_run and self.reconstruction is not None and not self.growing.complete:
            self.growing.finish()
        # What was published stays until there is something new to say.
        self.reconstruction = self.result = None
        self.growing.begin_again()

    def of_run(self, stamp: int) -> Reconstruction:
        """Return the reconstruction for a view's stamp."""
        run_ns = self.runs.run_of(stamp)
        given = self.parameters.target == "given"
        mine = self.reconstruction.run_ns if self.reconstruction is not None else self.target.run_ns
        if run_ns is not None and mine is not None and run_ns != mine:
            if not given or run_ns < mine:
                raise ViewError(
                    f"view stamped {stamp} ns is of the run of {run_ns} ns; that of {mine} ns is carved"
                )
            self.begin_again(another_run=True)
        if self.reconstruction is None:
            name = self.target.run_ns if self.target.run_ns is not None and not given else run_ns
            self.reconstruction = Reconstruction(
                self.target.decision,
                self.pipeline,
                compare=self.parameters.compare,
                compose=False,
                run_ns=name,
            )
        return self.reconstruction

    # What to say of it

    def waiting(self) -> str:
        """Say so if views wait for the target, or the rest of the run for a source that is away."""
        if self.inlet.held:
            return self.target.missing()
        silent_s = 0.0 if self.growing.final or self.growing.complete else self.growing.silent_s
        return f"the source of views has been silent for {silent_s:.0f} s" if silent_s else ""

    def state_counts(self) -> dict[str, int]:
        """Return the number of views in the grid, and whether they are complete."""
        made = self.reconstruction
        complete = hasattr(self, "growing") and self.growing.complete
        arc = round(math.degrees(made.arcs.covered_rad)) if made is not None else 0
        return {"views": len(made.stamps) if made else 0, "complete": int(complete), "arc_deg": arc}

    def state_values(self) -> dict[str, str]:
        """Return the run's name and the object's size so far."""
        made, result = self.reconstruction, self.result
        values = {} if made is None or made.run_ns is None else {"run": str(made.run_ns)}
        if result is None:
            return values
        values["verdict"], values["quality"] = result.verdict, result.quality.verdict
        if result.quality.reasons:
            values["reasons"] = "; ".join(result.quality.reasons)
        if (d := result.dimensions) is not None:
            values |= {name: repr(getattr(d, name)) for name in ("length_m", "width_m", "height_m")}
        return values

    # Views

    def work(self, stream: str, image: Any, info: Any) -> str | None:
        """Add one stage of a view; a repeated one changes nothing."""
        view = view_from_msgs(image, info, stream)
        target = self.target.target
        if target is None:
            raise NoTargetError("no target: topic target says that there is no object in the scene")
        if self.target.may_move and not looks_at(view.info, target.position_m):
            return None  # of the target before; the view of this one is on its way
        made = self.of_run(view.info.stamp_ns)
        if stream == "sub_aperture":
            made.add_others(process(view, stream, made.decision, self.pipeline))
        elif made.add(ProcessedView(target, self.pipeline, **{stream: view}), parts=_PARTS[stream]):
            self.growing.changed()
        return INTEGRATED

    def keeps_its_state(self) -> bool:
        """Say no: views of another graph may be in the grid."""
        return False

    def on_source(self, beat: Heartbeat) -> None:
        """Finish once a source says that every view has arrived."""
        own = beat.values.get("target", self.target.stamp) == self.target.stamp
        if beat.values.get("stream") != "sector" and own:
            if self.reconstruction is not None:
                self.reconstruction.views_lost = beat.counts.get("lost", 0)
            self.growing.source_says(self.inlet.instance in beat.values.get("finished_for", "").split())

    # Results

    def show(self) -> None:
        """Publish the changes."""
        if not self.active or self.rival:
            return
        before = self.growing.complete
        self.growing.set_rate(self.parameters.publish_hz)
        self.growing.tick(time.monotonic())
        if self.growing.complete and not before:
            self.tell_now()
            self.log_end()

    def log_end(self) -> None:
        """Log the run's result."""
        result = self.result
        if result is None:
            self.get_logger().info("complete: no view came, so no object is known")
            return
        d = result.dimensions
        found = result.verdict if d is None else f"{d.length_m:.3f} x {d.width_m:.3f} x {d.height_m:.3f} m"
        name = "" if result.run_ns is None else f" of run {result.run_ns}"
        self.get_logger().info(
            f"complete{name}: {result.views_used} views, {found} ({result.quality.verdict}); published"
        )
        slope = result.grid.seabed if result.grid is not None else None
        if slope is not None and slope.believed:
            self.get_logger().info(
                f"the seabed slopes by {math.degrees(slope.slope_rad):.1f}° against the track's level: the"
                " sonar's heights were corrected"
            )

    def wanted(self) -> bool:
        """Say whether anybody subscribes to unfinished results."""
        return any(publisher.get_subscription_count() for publisher in self.outlets.values())

    def publish_result(self) -> None:
        """Publish the present result; large messages of an unfinished one only if subscribed."""
        final = self.growing.final
        made = self.reconstruction
        if made is None:  # nothing came: no object as far as anybody knows
            run_ns = self.target.run_ns
            made = Reconstruction(self.target.decision, self.pipeline, compose=False, run_ns=run_ns)
        result = self.result = made.result(final=final)
        result.datum = self.place.publish(result.frame, result.run_ns, self.runs.last_of(result.run_ns))
        stamp = result.stamp_ns or self.now_ns()

        def looked_at(name: str) -> bool:
            return final or bool(self.outlet(name).get_subscription_count())

        for name, message in result_to_msgs(
            self.messages, result, stamp_ns=stamp, wanted=looked_at, before=self.highest
        ):
            self.outlet(name).publish(message)
        self.highest = max(numbered_objects(result), default=0)


def main() -> int:
    """Run the node."""
    return run_node(VoxelCarverNode)


if __name__ == "__main__":
    sys.exit(main())
