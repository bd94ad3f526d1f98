"""Node `sub_aperture`: makes the views of the full circle from the coherent image (section 3.1).

It also finds the target and checks the spectrum's sign, since it is the one node that has the image.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

from csas_shadow_ros.bags.check import ERROR, judge_band, judge_coverage, judge_geometry, judge_image
from csas_shadow_ros.core.errors import CsasError, TrackError, ViewError
from csas_shadow_ros.core.geometry import CoherentImage, Track
from csas_shadow_ros.core.parameters import SubApertureParameters, TargetParameters
from csas_shadow_ros.core.streaming import Stream
from csas_shadow_ros.core.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.target import choose_target, find_target, spectrum_sign_evidence
from csas_shadow_ros.core.volume import Target
from csas_shadow_ros.core.warm import warm_sub_apertures
from msg_adapters import (
    TOPICS,
    Heartbeat,
    Pairer,
    TargetBox,
    coherent_image_from_msgs,
    message_from_cdr,
    sector_from_msgs,
    stamp_to_ns,
    target_to_msg,
    track_from_msg,
    view_to_msgs,
)

from . import qos
from .base import INTEGRATED, CsasNode, Inlet, Source, run_node
from .params import part

#: Counts of a stream that somebody should hear of, and what they mean.
_IRREGULAR = {
    "repeated": "came again; it counts once",
    "out_of_order": "came after later ones; the result is the same",
    "late": "came after views that it changes were made; all views are made again",
}

#: So long the search for the whole run's target waits at most for views that are due already.
_DECIDE_S = 2.0


class SubApertureNode(CsasNode):
    """Takes `image` or `sector/*`, and `track`; publishes `target` and `sub_aperture/*`."""

    name = "sub_aperture"

    def setup(self) -> None:
        """Make outlets, then inlets."""
        self.forget()
        self.target = self.publisher("target", qos.LATCHED)
        self.source = Source(self, "sub_aperture", self.send_view)
        self.pairer = Pairer("image", capacity=2)
        # Raw, as views are: hundreds of megabytes are not to be copied in vain.
        self.subscribe_latched("image", self.take_raw_image, raw=True)
        self.subscribe_latched("camera_info", lambda msg: self.take_image(msg, is_info=True))
        self.subscribe_latched("track", self.take_track)
        self.sector_inlet = Inlet(self, "sector", "sink", self.take_sector)
        self.follow_sources()
        self.beginning = self.background(self.begin)
        self.advancing = self.background(self.advance)
        self.every(0.05, self.look_again)

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_sub_apertures()

    def forget(self) -> None:
        """Drop the run."""
        self.image: CoherentImage | None = None
        self.image_stamp: int | None = None
        self.track: Track | None = None
        #: A run that comes as sectors; None before the first one.
        self.stream: Stream | None = None
        self.revision = 0
        #: Views of the stream that are due as soon as the views of the target before are done.
        self.due: list[int] = []
        self.target_sent = 0
        self.source_ended = False
        #: When all sectors were here; None before, and once the whole run's target is decided on.
        self.ended_s: float | None = None
        self.refusals_sent: set[float] = set()
        self.sub_apertures: SubApertures | None = None
        self.aspects: dict[int, float] = {}
        self.failed = False

    def waiting(self) -> str:
        """Say which input is missing."""
        if self.stream is not None and (text := self.waiting_of_stream(self.stream)):
            return text
        if self.sub_apertures is not None:
            return self.source.flow.waiting_for() and f"waiting for {self.source.flow.waiting_for()}"
        if self.stream is not None:
            return ""
        missing = [n for n, x in (("image", self.image), ("track", self.track)) if x is None]
        return f"waiting for {' and '.join(missing)}" if missing else ""

    def waiting_of_stream(self, stream: Stream) -> str:
        """Say what is missing of a run that comes as sectors."""
        if stream.track is None:
            return "waiting for track"
        arc = math.degrees(stream.sum.arcs.covered_rad)
        if not stream.target_known:
            return f"waiting for more sectors to find the target in ({arc:.0f}° are here)"
        if stream.ended and (missing := stream.missing()):
            return f"no sectors came of {', '.join(map(str, missing))}"
        if self.source.flow.held:
            return "waiting until the views of the target before have left the graph"
        return "" if stream.ended else f"waiting for more sectors ({arc:.0f}° are here)"

    def state_counts(self) -> dict[str, int]:
        """Return how many sectors there are, how they came, and the arc that they cover."""
        if self.stream is None:
            return {"sectors": 0}
        counts, arcs = self.stream.counts, self.stream.sum.arcs
        names = ("sectors", "repeated", "out_of_order", "late")
        state = {name if name == "sectors" else f"sectors_{name}": counts[name] for name in names}
        return state | {"arc_deg": round(math.degrees(arcs.covered_rad)), "revision": self.stream.revision}

    # Inputs

    def take_raw_image(self, cdr: bytes) -> None:
        """Take the image as it was serialised."""
        self.take_image(message_from_cdr(cdr, TOPICS["image"].type_name, "image"), is_info=False)

    def take_image(self, msg: Any, *, is_info: bool) -> None:
        """Take the image or its camera_info; the same one comes again when a player restarts."""
        pair = self.pairer.add(msg, is_info=is_info)
        # A latched topic comes twice, by both subscriptions: its orphans are no news.
        self.pairer.orphans.clear()
        if pair is None:
            return
        stamp = stamp_to_ns(pair[0].header.stamp, "image.header.stamp")
        if self.failed and stamp != self.image_stamp:
            # What came before could not be processed at all: this may be it put right.
            self.failed, self.error, self.image_stamp = False, "", None
        if self.image_stamp is not None:
            if stamp != self.image_stamp:
                raise ViewError(
                    f"image stamped {stamp} ns came during the run of {self.image_stamp} ns; clean up and"
                    " configure the node again for another run"
                )
            return
        if self.stream is not None:
            raise ViewError(f"image stamped {stamp} ns came during a run of sectors; it is not used")
        self.image = coherent_image_from_msgs(*pair)
        self.image_stamp = stamp
        self.beginning.trigger()

    def take_track(self, msg: Any) -> None:
        """Take the track; of a track that grows during the run the longest is the whole."""
        track = track_from_msg(msg)
        if self.stream is not None:
            if self.stream.take_track(track):
                self.advancing.trigger()
            self.track = self.stream.track
            return
        if self.sub_apertures is not None:
            if len(track) > len(self.sub_apertures.track):
                raise TrackError(
                    f"a track of {len(track)} poses came after the views were begun with"
                    f" {len(self.sub_apertures.track)}; it is not used"
                )
            return
        for level, problem, remedy in judge_coverage(track):
            if level == ERROR:
                raise TrackError(f"{problem}. {remedy}")
        if self.track is None or len(track) >= len(self.track):
            self.track = track
            self.beginning.trigger()

    def take_sector(self, image: Any, info: Any) -> str:
        """Take one sector."""
        sector = sector_from_msgs(image, info)
        if self.image_stamp is not None:
            return INTEGRATED  # the run is here as a whole
        if self.stream is None:
            p = self.parameters
            self.stream = Stream(
                part(p, SubApertureParameters),
                part(p, TargetParameters),
                first_search_deg=p.first_search_deg,
            )
            if self.track is not None:
                self.stream.take_track(self.track)
            self.source.flow.more_to_come = True
        before = dict(self.stream.counts)
        self.stream.add(sector)
        for name, what in _IRREGULAR.items():
            if self.stream.counts[name] > before.get(name, 0):
                self.log_throttled(name, f"sector at {sector.stamp_ns} ns {what}", "warn")
        self.advancing.trigger()
        return INTEGRATED

    def on_source(self, beat: Heartbeat) -> None:
        """Close the run once the source of the sectors says that they are all here."""
        if self.stream is None or beat.values.get("stream") != "sector":
            return
        here = self.sector_inlet.instance in beat.values.get("finished_for", "").split()
        if here and not self.source_ended:
            self.source_ended = True
            self.stream.finish()
            self.advancing.trigger()

    # A run that comes as sectors

    def advance(self) -> None:
        """Offer the views that can be made by now; begin again where the target or the views have changed."""
        stream, flow = self.stream, self.source.flow
        if stream is None or self.failed:
            self.ended_s = None
            return
        decide = self.decides(stream)
        try:
            if decide or not stream.ended:
                self.judge_stream(stream)
            due = stream.update(decide=decide)
        except CsasError as error:
            self.fail(error)
            return
        if not stream.target_known:
            return
        if stream.revision != self.revision or not self.target_sent:
            self.revision, self.due, flow.held = stream.revision, [], True
        self.due += due
        if flow.held:
            self.begin_again()
        else:
            self.offer_due(stream)

    def decides(self, stream: Stream) -> bool:
        """Say whether it is time to decide on the whole run's target, once all sectors are here.

        The search takes a second. Views that are due already, and whoever looks at the grid, need not wait
        for it, unless they wait for something else themselves.
        """
        if not stream.ended or stream.final or not stream.target_known:
            self.ended_s = None
            return True
        if self.ended_s is None:
            self.ended_s = time.monotonic()
            return False  # the last sector's views are not even offered yet
        return not self.source.flow.pending or time.monotonic() - self.ended_s > _DECIDE_S

    def look_again(self) -> None:
        """Go on with what waits until views that are on their way have left the graph."""
        if self.ended_s is not None:
            self.advancing.trigger()
        self.begin_again()

    def begin_again(self) -> None:
        """Publish another target, and offer its views, once those of the one before have left the graph."""
        stream, flow = self.stream, self.source.flow
        if stream is None or not flow.held or flow.in_flight:
            return
        self.target_sent = max(stream.sum.newest_ns, self.target_sent + 1)
        self.publish_target(stream.target, self.target_sent, may_move=True)
        flow.begin_again(str(self.target_sent))
        self.aspects, flow.held = {}, False
        self.offer_due(stream)

    def offer_due(self, stream: Stream) -> None:
        """Offer the views that are due."""
        flow = self.source.flow
        self.sub_apertures = stream.sub_apertures
        if self.due:
            self.aspects |= {stamp: stream.aspect_of(stamp) for stamp in self.due}
            flow.offer(self.due)
            self.due = []
            self.source.wake()
        if stream.final:
            for aspect, reason in stream.refused.items():
                if aspect not in self.refusals_sent:
                    self.refusals_sent.add(aspect)
                    self.source.refused(self.target_sent, reason, aspect_deg=f"{math.degrees(aspect):.6g}")
        flow.more_to_come = not stream.final

    def judge_stream(self, stream: Stream) -> None:
        """Raise if image and track contradict each other; of the whole run also by what the image shows."""
        if stream.track is None or not stream.sum.stamps or stream.final:
            return
        frame = stream.sum.frame
        if stream.ended:
            found = [*judge_image(stream.sum.image(), stream.track)]
        else:
            found = [*judge_geometry(frame.grid, stream.track)]
            found += judge_band(frame.grid, frame.acoustics, stream.track)
        for level, problem, remedy in found:
            if level == ERROR:
                raise ViewError(f"{problem}. {remedy}")

    # Views

    def begin(self) -> None:
        """Find the target and list the views, once image and track are both here."""
        if self.image is None or self.track is None or self.sub_apertures is not None or self.failed:
            return
        try:
            for level, problem, remedy in judge_image(self.image, self.track):
                if level == ERROR:
                    raise ViewError(f"{problem}. {remedy}")
            spectrum = Spectrum.of_image(self.image)
            target = self.find_target(self.image, self.track, spectrum)
            p = part(self.parameters, SubApertureParameters)
            self.sub_apertures = SubApertures(self.image, self.track, p, spectrum=spectrum)
        except CsasError as error:
            self.fail(error)
            return
        self.publish_target(target, self.image_stamp or 0)
        self.list_views(self.sub_apertures)
        # Its spectrum is all that the views are made of: the pixels need not stay in memory.
        self.image = None

    def fail(self, error: CsasError) -> None:
        """Say that the run cannot be processed at all: once, and in every heartbeat."""
        self.failed, self.error = True, f"{type(error).__name__}: {error}"
        self.get_logger().error(self.error)

    def publish_target(self, target: Target | None, stamp: int, *, may_move: bool = False) -> None:
        """Publish the volume to carve, or that there is no object."""
        box = None
        if target is not None:
            x, y = target.position_m
            box = TargetBox((x, y, target.size_m[2] / 2.0), target.size_m)
        self.target.publish(target_to_msg(self.messages, box, stamp, may_move=may_move))

    def find_target(self, image: CoherentImage, track: Track, spectrum: Spectrum) -> Target | None:
        """Find the target as the in-process pipeline does."""
        p = part(self.parameters, TargetParameters)
        if not self.parameters.check_sign:
            return find_target(image, track, p, spectrum=spectrum)
        sign, search = spectrum_sign_evidence(image, track, spectrum=spectrum)
        sign.check()
        return choose_target(search, p)

    def list_views(self, sub_apertures: SubApertures) -> None:
        """Offer every view that the track allows; name the others."""
        for aspect in map(float, sub_apertures.aspects_rad):
            degrees = f"{math.degrees(aspect):.6g}"
            try:
                stamp = sub_apertures.info(aspect).stamp_ns
                if stamp in self.aspects:
                    raise ViewError(f"view of aspect {degrees}° has the stamp {stamp} ns of another view")
            except ViewError as error:
                # It has no stamp of its own: the sonar never was there.
                self.source.refused(self.image_stamp or 0, str(error), aspect_deg=degrees)
                continue
            self.aspects[stamp] = aspect
        self.source.flow.offer(self.aspects)
        self.source.wake()

    def send_view(self, stamp: int) -> None:
        """Make and publish the view of a stamp."""
        if self.sub_apertures is None:
            raise ViewError(f"view {stamp} ns was asked for before there is an image")
        view = self.sub_apertures.view_of_aspect(self.aspects[stamp])
        image, info = view_to_msgs(self.messages, view, "sub_aperture", trusted=True)
        self.source.info.publish(info)
        self.source.image.publish(image)


def main() -> int:
    """Run the node."""
    return run_node(SubApertureNode)


if __name__ == "__main__":
    sys.exit(main())
