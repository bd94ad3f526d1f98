"""Node `sub_aperture`: makes the views of the full circle from the coherent image (section 3.1).

It also finds the target and checks the spectrum's sign, since it is the one node that has the image.
"""

from __future__ import annotations

import math
import sys
from typing import Any

from csas_shadow_ros.bags.check import ERROR, judge_coverage, judge_image
from csas_shadow_ros.core.errors import CsasError, TrackError, ViewError
from csas_shadow_ros.core.geometry import CoherentImage, Track
from csas_shadow_ros.core.parameters import SubApertureParameters, TargetParameters
from csas_shadow_ros.core.sector import Sector, image_from_sectors
from csas_shadow_ros.core.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.target import Target, choose_target, find_target, spectrum_sign_evidence
from msg_adapters import (
    Heartbeat,
    Pairer,
    TargetBox,
    coherent_image_from_msgs,
    sector_from_msgs,
    stamp_to_ns,
    target_to_msg,
    track_from_msg,
    view_to_msgs,
)

from . import qos
from .base import INTEGRATED, CsasNode, Inlet, Source, run_node
from .params import part


class SubApertureNode(CsasNode):
    """Takes `image` or `sector/*`, and `track`; publishes `target` and `sub_aperture/*`."""

    name = "sub_aperture"

    def setup(self) -> None:
        """Make outlets, then inlets."""
        self.forget()
        self.target = self.publisher("target", qos.LATCHED)
        self.source = Source(self, "sub_aperture", self.send_view)
        self.pairer = Pairer("image", capacity=2)
        self.subscribe_latched("image", lambda msg: self.take_image(msg, is_info=False))
        self.subscribe_latched("camera_info", lambda msg: self.take_image(msg, is_info=True))
        self.subscribe_latched("track", self.take_track)
        self.sector_inlet = Inlet(self, "sector", "sink", self.take_sector)
        self.follow_sources()
        self.begin_guard = self.trigger(self.begin)

    def forget(self) -> None:
        """Drop the run."""
        self.image: CoherentImage | None = None
        self.image_stamp: int | None = None
        self.track: Track | None = None
        self.sectors: dict[int, Sector] = {}
        self.sub_apertures: SubApertures | None = None
        self.aspects: dict[int, float] = {}
        self.failed = False

    def waiting(self) -> str:
        """Say which input is missing."""
        if self.sub_apertures is not None:
            return self.source.flow.waiting_for() and f"waiting for {self.source.flow.waiting_for()}"
        if self.image is None and self.sectors:
            return f"waiting for the end of the sectors ({len(self.sectors)} are here)"
        missing = [n for n, x in (("image", self.image), ("track", self.track)) if x is None]
        return f"waiting for {' and '.join(missing)}" if missing else ""

    def state_counts(self) -> dict[str, int]:
        """Return how many sectors there are."""
        return {"sectors": len(self.sectors)}

    # Inputs

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
        self.image = coherent_image_from_msgs(*pair)
        self.image_stamp = stamp
        self.begin_guard.trigger()

    def take_track(self, msg: Any) -> None:
        """Take the track; of a track that grows during the run the longest is the whole."""
        track = track_from_msg(msg)
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
            self.begin_guard.trigger()

    def take_sector(self, image: Any, info: Any) -> str:
        """Take one sector."""
        sector = sector_from_msgs(image, info)
        if self.image_stamp is None:
            self.sectors.setdefault(sector.stamp_ns, sector)
        return INTEGRATED

    def on_source(self, beat: Heartbeat) -> None:
        """Sum the sectors once their source says that they are all here."""
        if self.image_stamp is not None or not self.sectors or beat.values.get("stream") != "sector":
            return
        if self.sector_inlet.instance in beat.values.get("finished_for", "").split():
            # In order of stamp: a sum of floats in another order would be another image.
            self.image = image_from_sectors(self.sectors[s] for s in sorted(self.sectors))
            self.image_stamp = self.image.stamp_ns
            self.begin_guard.trigger()

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
            # The run cannot be processed at all: said once, and in every heartbeat.
            self.failed, self.error = True, f"{type(error).__name__}: {error}"
            self.get_logger().error(self.error)
            return
        box = None
        if target is not None:
            x, y = target.position_m
            box = TargetBox((x, y, target.size_m[2] / 2.0), target.size_m)
        self.target.publish(target_to_msg(self.messages, box, self.image_stamp or 0))
        self.list_views(self.sub_apertures)
        # Its spectrum is all that the views are made of: the pixels need not stay in memory.
        self.image, self.sectors = None, {}

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
        image, info = view_to_msgs(self.messages, view, "sub_aperture")
        self.source.info.publish(info)
        self.source.image.publish(image)


def main() -> int:
    """Run the node."""
    return run_node(SubApertureNode)


if __name__ == "__main__":
    sys.exit(main())
