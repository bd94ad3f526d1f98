"""The result as a bag: every topic of the contract, views written one by one as they are made."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError

from msg_adapters.camera_info import GroundInfo
from msg_adapters.messages import RosbagsMessages
from msg_adapters.origin import origin_to_msg, scene_transform_to_msg
from msg_adapters.pairs import (
    coherent_image_to_msgs,
    ground_picture_to_msgs,
    view_to_msgs,
)
from msg_adapters.result import result_to_msgs
from msg_adapters.search import decision_to_msg
from msg_adapters.target import TargetBox, target_to_msg
from msg_adapters.topics import NAMESPACE, RESULT_TOPICS, STREAMS, TOPICS, absolute_name, topic
from msg_adapters.track import track_to_msg

from ..bags import BagReader, BagWriter
from ..core.errors import CsasError
from ..core.geometry import Acoustics, CoherentImage, Origin, Track, View
from ..core.shape.result import Result

#: Topics that a result's bag always has, whatever the run found.
_ALWAYS = (
    *("image", "camera_info", "track", "search", "target"),
    *(f"{s}/{part}" for s in ("multilook", "color_by_aspect") for part in ("image", "camera_info")),
    *RESULT_TOPICS,
)


class ResultBag:
    """Writes the bag of a result: a lone MCAP file that rosbag2 opens.

    Parameters
    ----------
    folder : Path
        Where to put ``result.mcap``.
    """

    FILE = "result.mcap"

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._factory = RosbagsMessages()
        self._work = folder / ".bag"
        # Hundreds of noisy views: zstd would take longer than all of the method.
        self._writer = BagWriter(self._work, compress="lz4", file_name=self.FILE)
        self._acoustics: Acoustics | None = None
        self._last_ns = 0
        self._adopted = False
        self._file: Path | None = None
        for name in _ALWAYS:
            self._writer.add_topic(absolute_name(name), TOPICS[name].type_name, depth=1)

    def _write(self, relative: str, message: Any, when_ns: int | None = None) -> None:
        self._writer.write(absolute_name(relative), message, when_ns)

    def write_source(
        self, image: CoherentImage | None, track: Track | None, reader: BagReader | None = None
    ) -> None:
        """Write the image and the track; from a reader as they were recorded, byte for byte.

        Parameters
        ----------
        image, track : CoherentImage, Track or None
            What was processed.
        reader : BagReader, optional
            The bag they came from, if they are the bag's own (not a sum of sectors, no other sign).
        """
        if image is not None:
            self._acoustics = image.acoustics
            self._last_ns = image.stamp_ns
        if track is not None:
            self._last_ns = max(self._last_ns, int(track.stamps_ns[-1]))
        if reader is not None:
            for message in reader.messages(["image", "camera_info", "track"]):
                relative = message.topic.removeprefix(f"{reader.namespace}/")
                # Whatever the namespace of the recording, the result has the contract's.
                self._writer.write(
                    absolute_name(relative, NAMESPACE),
                    message.cdr,
                    message.log_time_ns,
                    type_name=message.type_name,
                )
            return
        if track is not None:
            self._write("track", track_to_msg(self._factory, track), self._last_ns)
        if image is not None:
            picture, info = coherent_image_to_msgs(self._factory, image)
            self._write("camera_info", info, self._last_ns)
            self._write("image", picture, self._last_ns)

    def write_view(self, view: View, stream_name: str) -> None:
        """Write one view of a stream."""
        picture, info = view_to_msgs(self._factory, view, stream_name)
        self._write(STREAMS[stream_name].info_topic, info)
        self._write(STREAMS[stream_name].image_topic, picture)
        self._last_ns = max(self._last_ns, view.info.stamp_ns)
        self._acoustics = self._acoustics or view.info.acoustics

    def adopt(self, recording: Path, *, whole: bool) -> None:
        """Take over a recording of the node graph, which holds everything already.

        Parameters
        ----------
        recording : Path
            The bag.
        whole : bool
            It is taken as it is: its file becomes the result's. Otherwise it is copied, without results that
            were replaced as they grew.
        """
        from .recording import copy_recording

        files = list(recording.glob("*.mcap"))
        if whole and len(files) == 1:
            self._file = files[0].replace(self._folder / ".recorded.mcap")
        else:
            copy_recording(recording, self._writer)
        self._adopted = True

    def finish(self, result: Result) -> Path:
        """Write composites, grid, voxels, mesh and target (unless a recording has them), and close.

        Returns
        -------
        Path
            The file.
        """
        if not self._adopted:
            self._write_result(result)
        self._writer.close()
        path = self._folder / self.FILE
        (self._file or self._writer.file).replace(path)
        shutil.rmtree(self._work)
        return path

    def _write_result(self, result: Result) -> None:
        factory, when = self._factory, self._last_ns
        if result.composites is not None and result.composites.stamps and self._acoustics is not None:
            info = GroundInfo(when, result.composites.grid, self._acoustics, frame=result.frame)
            pictures = (
                ("multilook", result.composites.multilook()),
                ("color_by_aspect", result.composites.color_by_aspect()),
            )
            for name, pixels in pictures:
                picture, camera = ground_picture_to_msgs(factory, pixels, info, name)
                self._write(STREAMS[name].info_topic, camera)
                self._write(STREAMS[name].image_topic, picture)
        factory = factory.in_frame(result.frame)
        if result.decision is not None:
            self._write("search", decision_to_msg(factory, result.decision, when, result.run_ns, when))
        if result.datum is not None:
            origin = Origin(when, result.frame, result.datum)
            for name, message in (
                ("origin", origin_to_msg(factory, origin)),
                ("scene_transform", scene_transform_to_msg(factory, origin)),
            ):
                self._writer.add_topic(absolute_name(name), TOPICS[name].type_name, depth=1)
                self._write(name, message, when)
        box = None
        if result.target is not None:
            x, y = result.target.position_m
            box = TargetBox((x, y, result.target.size_m[2] / 2.0), result.target.size_m)
        self._write("target", target_to_msg(factory, box, when))
        for name, message in result_to_msgs(factory, result, stamp_ns=when):
            self._writer.add_topic(absolute_name(name), topic(name).type_name, depth=1)
            self._write(name, message, when)

    def discard(self) -> None:
        """Close and remove what has been written: the result goes on without a bag."""
        with contextlib.suppress(CsasError, OSError, McapError):
            self._writer.close()
        shutil.rmtree(self._work, ignore_errors=True)
        for name in (self.FILE, ".recorded.mcap"):
            with contextlib.suppress(OSError):
                (self._folder / name).unlink(missing_ok=True)

    def abandon(self) -> None:
        """Close what has been written; the folder is not going to be kept."""
        self._writer.close()
