"""The runs of a bag: time spans of its merged Paths, and the run to process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from csas_shadow_ros.core.errors import BagError, CsasError, quoted
from csas_shadow_ros.core.geometry import SCENE_FRAME, Origin, Track, TrackBook, ViewInfo, origin_of, passage
from msg_adapters.camera_info import view_info_from_msg
from msg_adapters.messages import frame_of
from msg_adapters.origin import origin_from_msg
from msg_adapters.topics import STREAMS, VIEW_STREAMS, absolute_name
from msg_adapters.track import track_piece_from_msg

from .bag import BagReader
from .pairs import Problem, checked_messages

if TYPE_CHECKING:
    from msg_adapters.camera_info import SectorInfo

#: A bag is read as a whole: as many runs as it holds.
_MAX_RUNS = 1 << 20


class BagRuns:
    """The runs of a bag, and the selected one.

    Parameters
    ----------
    reader : BagReader
        The bag.
    report : callable
        Called with each `Problem` of the Paths, and of runs that are not looked at.
    run : int, optional
        Which run: its name (stamp of its first pose, ns) or its number in time, from 1. The first one that
        has an image or sectors if not given, else the first one with views, else the first one.

    Raises
    ------
    BagError
        If the bag has no such run.
    """

    def __init__(
        self, reader: BagReader, report: Callable[[Problem], None] = lambda _: None, run: int | None = None
    ) -> None:
        self._reader = reader
        self.topic = absolute_name("track", reader.namespace)
        self.book = TrackBook(max_runs=_MAX_RUNS)
        for message, path, stamp in checked_messages(reader, "track", report, repeated=True):
            try:
                self.book.add(track_piece_from_msg(path))
            except CsasError as error:
                report(Problem(message.topic, message.number, stamp, str(error)))
        #: Names of all runs, in time.
        self.names = self.book.names
        self._stamps: dict[str, list[int]] = {}
        self.name = self._choose(run)
        if len(self.names) > 1:
            others = ", ".join(
                f"run {n} ({name}{self._holds(name)})"
                for n, name in enumerate(self.names, 1)
                if name != self.name
            )
            number = self.names.index(self.name or 0) + 1
            report(
                Problem(
                    self.topic,
                    None,
                    None,
                    f"the bag holds {len(self.names)} runs, named by their first poses' stamps in ns: run"
                    f" {number} ({self.name}) is used, not {others}; --run chooses another",
                )
            )

    def stamps(self, stream_name: str) -> list[int]:
        """Return the stamps of a stream's camera infos."""
        if stream_name not in self._stamps:
            topic = STREAMS[stream_name].info_topic
            self._stamps[stream_name] = [
                s for _, _, s in checked_messages(self._reader, topic, lambda _: None)
            ]
        return self._stamps[stream_name]

    def _choose(self, run: int | None) -> int | None:
        if run is not None:
            if run in self.names:
                return run
            if 1 <= run <= len(self.names):
                return self.names[run - 1]
            known = ", ".join(f"{n} ({name})" for n, name in enumerate(self.names, 1)) or "none"
            raise BagError(f"{self._reader.path}: there is no run {run}; runs of this bag: {known}")
        if len(self.names) < 2:
            return self.names[0] if self.names else None
        for streams in (("image", "sector"), tuple(VIEW_STREAMS)):
            for name in self.names:
                if any(name in self.book.runs_of(s) for stream in streams for s in self.stamps(stream)):
                    return name
        return self.names[0]

    def _holds(self, name: int) -> str:
        held = [
            f"{count} {stream}{'s' if count > 1 else ''}"
            for stream in ("image", "sector", *VIEW_STREAMS)
            if (count := sum(self.book.run_of(s) == name for s in self.stamps(stream)))
        ]
        return f": {', '.join(held)}" if held else ": no images"

    def covers(self, stamp_ns: int) -> bool:
        """Say whether a stamp is of the selected run; without tracks every stamp is."""
        return self.name is None or self.name in self.book.runs_of(stamp_ns)

    def is_of_another(self, stamp_ns: int) -> bool:
        """Say whether a stamp is of another run of this bag."""
        return not self.covers(stamp_ns) and bool(self.book.runs_of(stamp_ns))

    def not_covered(self, stamp_ns: int | None = None, what: str = "its stamp") -> str:
        """State that no track covers a stamp, what the tracks cover, and how far off it is."""
        return self.book.not_covered(stamp_ns, what)

    @property
    def frame(self) -> str:
        """Name of the scene's frame: that of the track, else of the first image, sector or view."""
        if self.name is not None:
            return self.book.frame(self.name)
        for name in ("image", "sector", *VIEW_STREAMS):
            for _, message, _ in checked_messages(self._reader, STREAMS[name].info_topic, lambda _: None):
                with contextlib.suppress(CsasError):  # named where they are read
                    return frame_of(message, name)
        return SCENE_FRAME

    def origin(self, report: Callable[[Problem], None]) -> tuple[Origin, bytes] | None:
        """Return the origin of this run's frame from topic origin, and the recorded message."""
        said: list[tuple[Origin, bytes]] = []
        for message, decoded, stamp in checked_messages(self._reader, "origin", report, repeated=True):
            try:
                said.append((origin_from_msg(decoded), bytes(message.cdr)))
            except CsasError as error:
                report(Problem(message.topic, message.number, stamp, str(error)))
        last_ns = None if self.name is None else self.book.span(self.name)[1]
        chosen = origin_of((origin for origin, _ in said), self.frame, last_ns)
        if said and chosen is None:
            other, topic = said[-1][0], absolute_name("origin", self._reader.namespace)
            reason = f"origin.header.frame_id is {quoted(other.frame)}; expected the run's, {self.frame!r}"
            report(Problem(topic, None, other.stamp_ns, f"{reason}: it gives no place"))
        return next((one for one in said if one[0] is chosen), None)

    def doubt(self, stamp_ns: int) -> str | None:
        """State that several tracks cover a stamp; None if not."""
        runs = self.book.runs_of(stamp_ns)
        if len(runs) < 2:
            return None
        others = ", ".join(str(name) for name in runs if name != self.name)
        return (
            f"{len(runs)} tracks cover its stamp, from different places: that of run {self.name} is used, not"
            f" {others}"
        )

    def _view_infos(self) -> list[ViewInfo]:
        """Return what the views of this run say of themselves, of the first stage that the bag has any of."""
        for stage in VIEW_STREAMS:
            found = []
            for _, message, stamp in checked_messages(
                self._reader, STREAMS[stage].info_topic, lambda _: None
            ):
                # What is not legible is named where the views are read.
                with contextlib.suppress(CsasError):
                    if self.covers(stamp):
                        found.append(view_info_from_msg(message, stage))
            if found:
                return found
        return []

    def track(
        self, image_ns: int | None, infos: Sequence[SectorInfo]
    ) -> tuple[Track | None, tuple[str, ...]]:
        """Return the passage that counts and notes on it; None and the reason if there is none."""
        if self.name is None:
            return None, ()
        named = infos or ([] if image_ns is not None else self._view_infos())
        sectors = [(i.stamp_ns, i.aspect_rad - i.aperture_rad / 2.0, i.aperture_rad) for i in named]
        notes = self.book.notes(self.name)
        try:
            found = passage(self.book.track(self.name), image_ns=image_ns, sectors=sectors)
        except CsasError as error:
            return None, (*notes, str(error))
        return found.track, (*notes, *found.notes)
