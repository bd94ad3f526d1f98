"""The result as a bag: every topic of the contract, views written one by one as they are made."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from msg_adapters.camera_info import GroundInfo
from msg_adapters.messages import RosbagsMessages
from msg_adapters.pairs import coherent_image_to_msgs, ground_picture_to_msgs, view_to_msgs
from msg_adapters.result import result_to_msgs
from msg_adapters.target import TargetBox, target_to_msg
from msg_adapters.topics import LATCHED, NAMESPACE, STREAMS, TOPICS, absolute_name, topic
from msg_adapters.track import track_to_msg

from ..bags import BagReader, BagWriter
from ..core.geometry import Acoustics, CoherentImage, Track, View
from ..core.pipeline import Result
from ..core.shape import result as plain


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
        for name in TOPICS:
            if name in LATCHED:
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

    def adopt(self, recording: Path) -> None:
        """Take over a recording of the node graph, which holds everything already."""
        from .recording import copy_recording

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
        self._writer.file.replace(path)
        shutil.rmtree(self._work)
        return path

    def _write_result(self, result: Result) -> None:
        factory, when = self._factory, self._last_ns
        if result.composites is not None and result.composites.stamps and self._acoustics is not None:
            info = GroundInfo(when, result.composites.grid, self._acoustics)
            pictures = (
                ("multilook", result.composites.multilook()),
                ("color_by_aspect", result.composites.color_by_aspect()),
            )
            for name, pixels in pictures:
                picture, camera = ground_picture_to_msgs(factory, pixels, info, name)
                self._write(STREAMS[name].info_topic, camera)
                self._write(STREAMS[name].image_topic, picture)
        box = None if result.grid is None else TargetBox.of(result.grid.volume)
        self._write("target", target_to_msg(factory, box, when))
        for name, message in result_to_msgs(factory, _as_plain(result, when), stamp_ns=when):
            # Those under a prefix are not known beforehand.
            self._writer.add_topic(absolute_name(name), topic(name).type_name, depth=1)
            self._write(name, message, when)

    def abandon(self) -> None:
        """Close what has been written; the folder is not going to be kept."""
        self._writer.close()


def _as_plain(result: Result | plain.Result, stamp_ns: int) -> plain.Result:
    """Return the plain data of what the pipeline left in this process."""
    if isinstance(result, plain.Result):
        return result
    return plain.Result(
        stamp_ns=stamp_ns,
        verdict="object" if result.objects else "no object",
        target=result.target,
        sign=result.sign,
        grid=result.grid,
        other_grid=result.other_grid,
        mesh=result.mesh,
        dimensions=result.dimensions,
        matter=result.matter,
        matter_mesh=result.matter_mesh,
        views_used=result.views_used,
        further=[
            plain.ObjectResult(o.target, o.grid, o.mesh, o.dimensions, o.views_used) for o in result.further
        ],
        left_out=[plain.LeftOut(body.position_m, body.reason) for body in result.left_out],
    )
