"""Node `sub_aperture`: makes the views of the full circle from the coherent image (section 3.1).

It also finds the target and checks the spectrum's sign, since it is the one node that has the image.

A mission circles one contact after another. Image, sectors and poses are sorted into runs by their stamps.
One run's views are sent at a time, and the next one's once they have left the graph.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field, replace
from typing import Any

from csas_shadow_ros.bags.check import ERROR, judge_coverage, judge_geometry, judge_image
from csas_shadow_ros.core.errors import CsasError, TrackError, ViewError
from csas_shadow_ros.core.geometry import CoherentImage, Track
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.parameters import SubApertureParameters, TargetParameters
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.sectors.streaming import Stream
from csas_shadow_ros.core.warm import warm_sub_apertures
from msg_adapters import (
    TOPICS,
    Heartbeat,
    Pairer,
    TargetBox,
    coherent_image_from_msgs,
    data_stamp_to_ns,
    decision_to_msg,
    frame_of,
    message_from_cdr,
    sector_from_msgs,
    stamp_to_ns,
    target_to_msg,
    view_to_msgs,
)

from . import qos
from .runtime.base import INTEGRATED, CsasNode, Inlet, Source, run_node
from .runtime.params import part
from .runtime.runs import HOLD_S, RunFollower

#: Counts of a stream that somebody should hear of, and what they mean.
_IRREGULAR = {
    "repeated": "came again; it counts once",
    "out_of_order": "came after later ones; the result is the same",
    "late": "came after the views that it changes; all views are made again",
}
#: So long the search for the whole run's target waits at most for views that are due already.
_DECIDE_S = 2.0
#: Runs that may wait for the one whose views are sent: each holds a spectrum of the image's size.
_MOST_WAITING = 2
#: Images that may wait for a track that covers their stamp.
_MOST_UNPLACED = 2


@dataclass(eq=False)
class Run:
    """One circle of one contact, so far.

    Parameters
    ----------
    name : int or None
        Stamp of its track's first pose; None as long as there is no track.
    stream : Stream
        What can be made of it.
    """

    name: int | None
    stream: Stream
    #: Its full-circle image, until it has been held against the track; and that image's stamp.
    image: CoherentImage | None = None
    image_stamp: int | None = None
    #: Why it cannot be processed at all; empty if it can.
    failed: str = ""
    revision: int = 0
    #: Views that are due as soon as the views of the target before are done.
    due: list[int] = field(default_factory=list)
    target_sent: int = 0
    #: When all sectors were here; None before, and once the whole run's target is decided on.
    ended_s: float | None = None
    refusals_sent: set[float] = field(default_factory=set)
    #: The track that was found not to go round the circle.
    judged: Track | None = None


class SubApertureNode(CsasNode):
    """Takes `image` or `sector/*`, and `track`; publishes `search`, `target` and `sub_aperture/*`."""

    name = "sub_aperture"
    alone = True

    def setup(self) -> None:
        """Make outlets, then inlets."""
        self.forget()
        self.search = self.publisher("search", qos.LATCHED)
        self.target = self.publisher("target", qos.LATCHED)
        self.source = Source(self, "sub_aperture", self.send_view)
        self.pairer = Pairer("image", capacity=2)
        # Raw, as views are: hundreds of megabytes are not to be copied in vain.
        self.subscribe_latched("image", self.take_raw_image, raw=True)
        self.subscribe_latched("camera_info", lambda msg: self.take_image(msg, is_info=True))
        self.track = RunFollower(self, self.take_track)
        self.sector_inlet = Inlet(self, "sector", "sink", self.take_sector, hold=self.track.hold)
        self.follow_sources()
        self.advancing = self.background(self.advance)
        self.every(0.05, self.look_again)

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_sub_apertures()

    def forget(self) -> None:
        """Drop all runs."""
        #: Those that are not over, the one whose views are sent first.
        self.runs: list[Run] = []
        #: Names of those that are, and the stamps of their images.
        self.over: dict[int | None, int | None] = {}
        #: Images whose stamp no known track covers, and since when they wait.
        self.unplaced: list[tuple[float, Any, Any]] = []
        self.sub_apertures: SubApertures | None = None
        self.aspects: dict[int, float] = {}

    def keeps_its_state(self) -> bool:
        """Return True once a run has begun; before that, its image may have been missed."""
        return bool(self.runs or self.over)

    @property
    def run(self) -> Run | None:
        """The run now being sent."""
        return self.runs[0] if self.runs else None

    # What to say of it

    def waiting(self) -> str:
        """Say which input is missing."""
        run = self.run
        if run is None:
            lacking = "track" if self.unplaced else "image" if self.track.book.names else "image and track"
            if self.over:
                return "" if not self.unplaced else "waiting for a track that covers the image's stamp"
            return f"waiting for {lacking}"
        if run.failed:
            return ""
        stream = run.stream
        if stream.track is None:
            return "waiting for track"
        arc = math.degrees(stream.sum.arcs.covered_rad)
        if not stream.target_known:
            if stream.ended:
                return "waiting for a track that goes round the circle"
            return f"waiting for more sectors to find the target in ({arc:.0f}° are here)"
        if stream.ended and run.image_stamp is None and (missing := stream.missing()):
            return f"no sectors came of {', '.join(map(str, missing))}"
        if self.source.flow.held:
            return "waiting until the views of the target before have left the graph"
        if stream.ended:
            return self.source.flow.waiting_for() and f"waiting for {self.source.flow.waiting_for()}"
        return f"waiting for more sectors ({arc:.0f}° are here)"

    def state_counts(self) -> dict[str, int]:
        """Return the number of sectors and their irregularities, the covered arc, and the runs."""
        run = self.run
        state = {"sectors": 0, "runs_over": len(self.over), "runs_waiting": max(0, len(self.runs) - 1)}
        if run is None or run.image_stamp is not None:
            return state
        counts, arcs = run.stream.counts, run.stream.sum.arcs
        names = ("sectors", "repeated", "out_of_order", "late")
        state |= {name if name == "sectors" else f"sectors_{name}": counts[name] for name in names}
        return state | {"arc_deg": round(math.degrees(arcs.covered_rad)), "revision": run.stream.revision}

    def state_values(self) -> dict[str, str]:
        """Return the run's name."""
        return {} if self.run is None or self.run.name is None else {"run": str(self.run.name)}

    # Inputs

    def take_raw_image(self, cdr: bytes) -> None:
        """Handle a serialised image."""
        self.take_image(message_from_cdr(cdr, TOPICS["image"].type_name, "image"), is_info=False)

    def take_image(self, msg: Any, *, is_info: bool) -> None:
        """Handle the image or its camera_info; a restarted player sends them again."""
        pair = self.pairer.add(msg, is_info=is_info)
        # A latched topic comes twice, by both subscriptions: its orphans are no news.
        self.pairer.orphans.clear()
        frame_of(msg, "camera_info" if is_info else "image", self.parameters.scene_frame)
        if pair is not None:
            self.place_image(*pair, time.monotonic())

    def place_image(self, image: Any, info: Any, since_s: float) -> None:
        """Assign an image to the run with a track over its stamp; without one it waits."""
        stamp = data_stamp_to_ns(image.header.stamp, "image.header.stamp")
        reason, patience_s = self.track.image_hold(stamp)
        if not reason:
            self.take_run_image(self.track.run_of(stamp), stamp, image, info)
        elif time.monotonic() - since_s > patience_s:
            raise ViewError(f"image stamped {stamp} ns: {reason}; ignored")
        else:
            others = [held for held in self.unplaced if stamp_to_ns(held[1].header.stamp) != stamp]
            for _, given_up, _ in others[: 1 - _MOST_UNPLACED]:
                gone = stamp_to_ns(given_up.header.stamp)
                self.reject(
                    f"image stamped {gone} ns: {reason}, and {_MOST_UNPLACED} newer ones wait for one"
                )
            self.unplaced = [*others[1 - _MOST_UNPLACED :], (since_s, image, info)]

    def take_run_image(self, name: int | None, stamp: int, image: Any, info: Any) -> None:
        """Begin a run with its full-circle image."""
        if name in self.over and self.over[name] == stamp:
            return
        run = self.run_named(name, f"image stamped {stamp} ns")
        if run.failed and run.image_stamp != stamp:
            # What came before could not be processed at all: this may be it put right.
            self.runs[self.runs.index(run)] = run = self.new_run(name)
            self.error = ""
        if run.image_stamp == stamp:
            return
        if run.image_stamp is not None:
            raise ViewError(
                f"image stamped {stamp} ns came during the run of {run.image_stamp} ns, the same run"
                " by its track; ignored"
            )
        coherent = coherent_image_from_msgs(image, info)
        run.stream.take_image(coherent)
        run.image, run.image_stamp = coherent, stamp
        self.advancing.trigger()

    def take_track(self, name: int, renamed: dict[int, int]) -> None:
        """Handle new poses of a run's track."""
        for run in self.runs:
            if run.name is not None:
                run.name = renamed.get(run.name, run.name)
            if run.name is None and run.stream.sum.stamps:
                run.name = self.track.run_of(min(run.stream.sum.stamps))
            if run.name == name:
                self.give_track(run)
        held, self.unplaced = self.unplaced, []
        for since_s, image, info in held:
            self.guard("image", self.place_image, image, info, since_s)
        self.sector_inlet.release()
        self.advancing.trigger()

    def take_sector(self, image: Any, info: Any) -> str:
        """Handle one sector."""
        sector = sector_from_msgs(image, info)
        name = self.track.run_of(sector.stamp_ns)
        if name in self.over:
            if self.over[name] is not None:
                return INTEGRATED  # that run was here as a whole
            raise ViewError(f"sector at {sector.stamp_ns} ns came after the run of {name} ns was over")
        run = self.run_named(name, f"sector at {sector.stamp_ns} ns")
        if run.image_stamp is not None:
            return INTEGRATED  # the run is here as a whole
        before = dict(run.stream.counts)
        run.stream.add(sector)
        for kind, what in _IRREGULAR.items():
            if run.stream.counts[kind] > before.get(kind, 0):
                self.log_throttled(kind, f"sector at {sector.stamp_ns} ns {what}", "warn")
        self.advancing.trigger()
        return INTEGRATED

    def run_named(self, name: int | None, what: str) -> Run:
        """Return a run that is not over, starting it if needed."""
        for run in self.runs:
            if run.name == name:
                return run
        if name in self.over:
            raise ViewError(f"{what} came after the run of {name} ns was over; ignored")
        if len(self.runs) > _MOST_WAITING:
            raise ViewError(
                f"{what} begins another run while {_MOST_WAITING} wait for that of {self.runs[0].name} ns;"
                " ignored"
            )
        run = self.new_run(name)
        self.runs.append(run)
        return run

    def new_run(self, name: int | None) -> Run:
        """Make a run."""
        p = self.parameters
        stream = Stream(
            part(p, SubApertureParameters),
            part(p, TargetParameters),
            first_search_deg=p.first_search_deg,
            max_objects=p.max_objects,
        )
        run = Run(name, stream)
        if name is not None:
            self.give_track(run)
        return run

    def give_track(self, run: Run) -> None:
        """Give a run all of its known poses; log those that do not count."""
        if run.name is None:
            return
        try:
            run.stream.take_track(self.track.book.track(run.name))
        except TrackError as error:
            self.log_throttled("track", f"track of the run of {run.name} ns: {error}", "warn")  # it may grow
        for note in (*self.track.book.notes(run.name), *run.stream.notes):
            self.log_throttled(note, note, "warn")

    def on_source(self, beat: Heartbeat) -> None:
        """Close the run once the source of the sectors says that all have arrived."""
        if not self.runs or beat.values.get("stream") != "sector":
            return
        run = self.runs[-1]
        here = self.sector_inlet.instance in beat.values.get("finished_for", "").split()
        if here and not run.stream.ended:
            run.stream.finish()
            self.advancing.trigger()

    # One run after another

    def advance(self) -> None:
        """Offer the views that can be made; begin again if the target or the views have changed."""
        run, flow = self.run, self.source.flow
        if run is None:
            return
        if len(self.runs) > 1 and not run.stream.ended:
            run.stream.finish()  # the vehicle is at the next one
        if run.failed:
            run.ended_s = None
            self.go_on(run)
            return
        stream = run.stream
        decide = self.decides(run)
        try:
            if (decide or not stream.ended) and not self.judge(run):
                return
            due = stream.update(decide=decide)
        except CsasError as error:
            self.fail(run, error)
            return
        if not stream.target_known:
            self.go_on(run)
            return
        if stream.revision != run.revision or not run.target_sent:
            run.revision, run.due, flow.held = stream.revision, [], True
        run.due += due
        if flow.held:
            self.begin_again()
        else:
            self.offer_due(run)
        self.go_on(run)

    def decides(self, run: Run) -> bool:
        """Say whether to decide on the whole run's target now that all sectors have arrived.

        The search takes a second. Views that are due already, and whoever looks at the grid, need not wait
        for it, unless they wait for something else themselves.
        """
        stream = run.stream
        if not stream.ended or stream.final or not stream.target_known:
            run.ended_s = None
            return True
        if run.ended_s is None:
            run.ended_s = time.monotonic()
            return False  # the last sector's views are not even offered yet
        return not self.source.flow.pending or time.monotonic() - run.ended_s > _DECIDE_S

    def look_again(self) -> None:
        """Resume work that waits until views in flight have left the graph."""
        if (self.run is not None and self.run.ended_s is not None) or len(self.runs) > 1:
            self.advancing.trigger()
        self.begin_again()

    def tick(self) -> None:
        """Refuse messages that have waited too long for their track, by name."""
        held, self.unplaced = self.unplaced, []
        for since_s, image, info in held:
            if time.monotonic() - since_s > HOLD_S:
                self.guard("image", self.place_image, image, info, since_s)
            else:
                self.unplaced.append((since_s, image, info))

    def begin_again(self) -> None:
        """Publish another target and offer its views, once the previous views have left the graph."""
        run, flow = self.run, self.source.flow
        if run is None or not flow.held or flow.in_flight:
            return
        stream = run.stream
        if stream.decision is None:
            return
        whole = run.image_stamp is not None
        run.target_sent = max(stream.sum.newest_ns, run.target_sent + 1)
        self.publish_decision(stream.decision, run, may_move=not whole)
        flow.begin_again(str(run.target_sent))
        self.aspects, flow.held = {}, False
        self.offer_due(run)

    def offer_due(self, run: Run) -> None:
        """Offer the views that are due."""
        flow, stream = self.source.flow, run.stream
        self.sub_apertures = stream.sub_apertures
        if run.due:
            self.aspects |= {stamp: stream.aspect_of(stamp) for stamp in run.due}
            flow.offer(run.due)
            run.due = []
            self.source.wake()
        if stream.final:
            for aspect, reason in stream.refused.items():
                if aspect not in run.refusals_sent:
                    run.refusals_sent.add(aspect)
                    self.source.refused(run.target_sent, reason, aspect_deg=f"{math.degrees(aspect):.6g}")
        flow.more_to_come = not stream.final

    def go_on(self, run: Run) -> None:
        """Begin the next run once this one's views have left the graph, or this one has failed."""
        flow, stream = self.source.flow, run.stream
        if len(self.runs) < 2:
            return
        hopeless = bool(run.failed) or (stream.ended and not stream.target_known)
        through = stream.final and not run.due and not flow.held and (flow.finished or not flow.total)
        if not (hopeless or through):
            return
        if hopeless and not run.failed:
            self.reject(f"giving up the run of {run.name} ns: {self.waiting() or 'it has no views'}")
        self.over[run.name] = run.image_stamp
        while len(self.over) > 16:
            self.over.pop(next(iter(self.over)))
        self.runs.pop(0)
        self.error = ""
        flow.held = True
        self.get_logger().info(f"the run of {self.runs[0].name} ns begins")
        self.advancing.trigger()

    def judge(self, run: Run) -> bool:
        """Check that image and track may belong together, as far as known; raise if they cannot."""
        stream = run.stream
        if stream.track is None or not stream.sum.stamps or stream.final:
            return True
        found = []
        frame = stream.sum.frame
        if run.image_stamp is not None and run.image is not None:
            for level, problem, remedy in judge_coverage(stream.track):
                if level == ERROR:
                    if run.judged is not stream.track:
                        run.judged = stream.track
                        self.reject(f"{problem}. {remedy}")
                    return False  # it may still grow
            found = [*judge_image(run.image, stream.track)]
        elif run.image_stamp is None and stream.ended:
            found = [*judge_image(stream.sum.image(), stream.track)]
        elif run.image_stamp is None:
            # Its lattice holds the band: a sector that folds it is refused by itself.
            found = [*judge_geometry(frame.grid, stream.track)]
        for level, problem, remedy in found:
            if level == ERROR:
                raise ViewError(f"{problem}. {remedy}")
            self.log_throttled(problem, f"{problem}. {remedy}", "warn")
        # Its spectrum is all that the views are made of: the pixels need not stay in memory.
        run.image = None
        return True

    def fail(self, run: Run, error: CsasError) -> None:
        """Announce that the run cannot be processed: once in the log, and in every heartbeat."""
        run.failed, run.image = f"{type(error).__name__}: {error}", None
        self.error = run.failed
        self.get_logger().error(self.error)
        self.go_on(run)

    def publish_decision(self, decision: Decision, run: Run, *, may_move: bool) -> None:
        """Publish the decision, and the target's volume on its own topic."""
        stamp, frame = run.target_sent, run.stream.sum.frame.frame
        decision = replace(decision, frame=frame)
        # First, so that whoever takes the target knows what else there is.
        self.search.publish(
            decision_to_msg(self.messages, decision, stamp, run.name, stamp, may_move=may_move)
        )
        box, target = None, decision.target
        if target is not None:
            x, y = target.position_m
            box = TargetBox((x, y, target.size_m[2] / 2.0), target.size_m)
        messages = self.messages.in_frame(frame)
        self.target.publish(target_to_msg(messages, box, stamp, may_move=may_move))

    # Views

    def send_view(self, stamp: int) -> None:
        """Make and publish the view of a stamp."""
        if self.sub_apertures is None:
            raise ViewError(f"view {stamp} ns requested before any image")
        view = self.sub_apertures.view_of_aspect(self.aspects[stamp])
        image, info = view_to_msgs(self.messages, view, "sub_aperture", trusted=True)
        self.source.info.publish(info)
        self.source.image.publish(image)


def main() -> int:
    """Run the node."""
    return run_node(SubApertureNode)


if __name__ == "__main__":
    sys.exit(main())
