"""Feeding the store from a results folder or a bag."""

from __future__ import annotations

import itertools
import logging
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.camera_info import view_info_from_msg
from msg_adapters.image import image_from_msg
from msg_adapters.measurements import measurements_from_msg
from msg_adapters.pairs import ground_picture_from_msgs, view_from_msgs, voxel_grid_from_msgs
from msg_adapters.target import TargetBox, target_from_msg
from msg_adapters.topics import STREAMS, VIEW_STREAMS
from msg_adapters.track import track_from_msg

from ..bags import BagReader, iterate_pairs, read_run
from ..bags.index import BagIndex
from ..bags.pairs import checked_messages
from ..core.errors import BagError, CsasError
from ..core.geometry import View
from ..core.parameters import CarvingParameters, PipelineParameters
from ..core.shape.threshold import thresholded
from ..core.shape.volume import Volume, VoxelGrid
from ..results.layout import looks_like_results, read_report
from . import codes
from .contacts import about, contacts_of
from .desk import Desk
from .store import Entry, Spool, ViewerError, ViewStore

log = logging.getLogger(__name__)
RESULT_BAG = "result.mcap"
#: So many faults are told one by one on the page.
_TOLD = 6
#: A truth of more triangles is not shown over the object: it would weigh more than the views.
_MOST_FACES = 50_000


def codes_of(name: str, pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return what of a stream's pixels is shown."""
    if name == "shadow_mask":
        return np.ascontiguousarray(pixels)
    return codes.likelihood_codes(pixels) if name == "likelihood" else codes.amplitude_codes(pixels)


def spooled(spool: Spool, name: str, view: View) -> Entry:
    """Make the entry of a view that came by; its codes are kept on disk."""
    pixels = codes_of(name, view.pixels)
    return Entry(view.info, f"{zlib.crc32(pixels.tobytes()):08x}", spool.put(pixels))


def grid_of(
    volume: Volume, likelihood: NDArray[np.float32], views: NDArray[Any] | None, p: CarvingParameters
) -> VoxelGrid:
    """Make the grid of what came as messages."""
    if views is None:
        views = np.where(np.isnan(likelihood), 0, 1)
    return thresholded(volume, likelihood, views.astype(np.uint16), p)


def grid_of_folder(folder: Path, method: str) -> VoxelGrid:
    """Read ``grid.npz``."""
    return grid_of_file(folder / "grid.npz", method)


def grid_of_file(path: Path, method: str) -> VoxelGrid:
    """Read a grid as a results folder holds it.

    Raises
    ------
    ViewerError
        If it is damaged: any part of it may be what a broken disk or a full one left.
    """
    try:
        # Opened here: of a file that is none numpy would leave it open.
        with path.open("rb") as file, np.load(file) as data:
            x, y, z = (float(v) for v in data["origin_m"])
            likelihood = data["likelihood"]
            volume = Volume((x, y, z), float(data["voxel_size_m"]), likelihood.shape)
            threshold = float(data["threshold"])
            return VoxelGrid(volume, likelihood, data["views"], threshold, data["occupied"], method)
    except Exception as error:  # of zipfile, zlib, numpy and the grid's own: what was read is no grid
        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise ViewerError(f"{path} cannot be read: {what}; make it again: csas-shadow run") from error


def box_json(box: TargetBox | None) -> dict[str, Any] | None:
    """Return the carved volume's box as the page takes it."""
    return None if box is None else {"centre": list(box.centre_m), "size": list(box.size_m)}


class PathSource:
    """Feeds a store from a results folder or a bag, first what is seen first.

    Parameters
    ----------
    store : ViewStore
        The store.
    path : path-like
        A results folder (with its ``result.mcap`` for the views), or a bag.
    namespace : str, optional
        Namespace of a bag's topics; found by itself if not given.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see.
    """

    def __init__(self, store: ViewStore, path: str | Path, namespace: str | None = None) -> None:
        self.store = store
        path = Path(path)
        store.title = path.resolve().name
        self._report: dict[str, Any] = {}
        self.parameters = PipelineParameters()
        self._folder: Path | None = None
        #: What was damaged or unusable, a line each.
        self.problems: list[str] = []
        if looks_like_results(path):
            self._folder = path
            try:
                self._report = read_report(path)
            except CsasError as error:
                self._problem(error)  # the views are worth a look
            path = path / RESULT_BAG
            if not path.exists():
                raise ViewerError(
                    f"{self._folder} holds no {RESULT_BAG}, so no views; expected a run without --no-bag"
                )
            self._use_report()
        self._bag = path
        self._reader = BagReader(path, namespace if self._folder is None else None)
        self._spool = Spool()
        self._thread: threading.Thread | None = None
        self.done = threading.Event()
        #: Why not all could be read; empty if it could.
        self.failed = ""
        held = [s for s in VIEW_STREAMS if (t := self._reader.topic(STREAMS[s].image_topic)) and t.count]
        if not held and (verdict := self._report.get("verdict")):
            raise ViewerError(f"{self._folder} holds no views to look at: its run says {verdict!r}")
        if not held:
            raise ViewerError(
                f"{path} holds no views ({', '.join(VIEW_STREAMS)});"
                f" make them: csas-shadow run {path} --out DIR"
            )
        self._held = held

    def _problem(self, problem: object) -> None:
        """Name what is wrong, once, in the log and on the page: nothing is missing without a word."""
        line = str(problem)
        if line in self.problems:
            return
        self.problems.append(line)
        log.warning("%s", line)
        more = f"; and {len(self.problems) - _TOLD} more" if len(self.problems) > _TOLD else ""
        self.store.put_part("damage", "; ".join(self.problems[:_TOLD]) + more)

    def _use_report(self) -> None:
        p = self._report.get("parameters", {})
        values = {
            part.name: type(getattr(self.parameters, part.name)).from_mapping(p.get(part.name, {}))
            for part in self.parameters.__dataclass_fields__.values()
            if part.name in p
        }
        self.parameters = replace(self.parameters, **values)

    def start(self) -> None:
        """Register what can be read at once; the rest goes on in a thread."""
        # What is found comes first: a page that is open already would say that there is nothing.
        self._findings()
        self.store.put_part("progress", {"state": "loading"})
        first = [s for s in ("shadow", "sub_aperture") if s in self._held] or self._held[:1]
        try:
            index: BagIndex | None = BagIndex(self._reader)
        except BagError as error:
            log.info("%s", error)  # read from end to end instead: damage is named on the way
            index = None
        if index is not None:
            # In turn: both pictures have their own layer from the first view on.
            for _ in itertools.zip_longest(*(self._register(index, name) for name in first)):
                pass
        self._small_parts()
        self._thread = threading.Thread(target=self._rest, args=(index, first), name="viewer", daemon=True)
        self._thread.start()

    def _register(self, index: BagIndex, name: str) -> Iterator[None]:
        infos = {}
        for _, message, stamp in checked_messages(self._reader, STREAMS[name].info_topic, self._problem):
            try:
                infos[stamp] = view_info_from_msg(message, name)
            except CsasError as error:
                self._problem(f"{STREAMS[name].info_topic}: {error}")
        stat = Path(self._bag).stat()
        revision = f"{(stat.st_mtime_ns ^ stat.st_size) & 0xFFFFFFFF:08x}"
        # Each as it is found: where a recorder wrote the bag, they are found by reading all of it.
        for stamp, read in index.places(name, set(infos)):

            def load(read: Callable[[], Any] = read, name: str = name) -> NDArray[np.uint8]:
                return codes_of(name, image_from_msg(read(), name))

            self.store.put_view(name, Entry(infos[stamp], revision, load))
            yield

    def _findings(self) -> None:
        store = self.store
        if self._report:
            store.put_dimensions(self._report.get("dimensions"))
            truth = self._report.get("truth")
            store.put_part("truth", truth.get("dimensions") if isinstance(truth, dict) else None)
            store.put_part("status", self._report.get("verdict", ""))
            self._guarded("report.json", lambda: store.put_part("report", about(self._report)))
            self._guarded("report.json", lambda: store.put_part("contacts", contacts_of(self._report)))
        if self._folder is not None:
            self._open_desk(self._folder)

    def _small_parts(self) -> None:
        store = self.store
        for _, message, _ in checked_messages(self._reader, "track", self._problem):
            store.put_track(track_from_msg(message))
        for _, message, _ in checked_messages(self._reader, "target", self._problem):
            store.put_part("target", box_json(target_from_msg(message)))
        store.put_part("reduced", bool(self._reader.topic("image") or self._reader.topic("sector/image")))
        store.make_reduced = self._make_reduced

    def _guarded(self, what: str, work: Callable[[], Any]) -> None:
        """Do a part of the work; what fails is named, and costs no other part."""
        try:
            work()
        except Exception as error:  # whatever a damaged file makes of it, it is to be seen on the page
            kind = "" if isinstance(error, CsasError) else f"{what}: {type(error).__name__}: "
            self.failed = self.failed or f"{kind}{error}"
            self._problem(f"{kind}{error}")

    def _open_desk(self, folder: Path) -> None:
        desk = Desk(folder)
        try:
            self.store.put_desk(desk.document())
            self.store.desk = desk
        except CsasError as error:
            # What cannot be read is not written over.
            self._problem(error)
            self.store.put_part("desk", {"why": str(error), "revision": 0, "items": {}})

    def _further_objects(self) -> None:
        p = self.parameters.carving
        for entry in self._report.get("objects") or []:
            name = str(entry["files"][0])
            if self._folder is not None and name != "grid.npz":
                grid = grid_of_file(self._folder / name, str(self._report.get("method", p.method)))
                self.store.put_grid(Path(name).stem, grid, p.min_views_fraction)

    def _truth(self) -> None:
        truth = self._report.get("truth")
        path = Path(str(truth.get("mesh", ""))) if isinstance(truth, dict) else Path()
        if path.suffix != ".stl" or not path.is_file():  # it lies beside the bag, which may be elsewhere
            return
        import trimesh  # late: takes half a second, and the first picture waits for this module

        mesh = trimesh.load_mesh(path)
        if len(mesh.faces) <= _MOST_FACES:
            self.store.put_mesh("truth", mesh)

    def _make_reduced(self) -> None:
        from .derived import Reduced  # late: compiles kernels

        run = read_run(self._bag, self._reader.namespace)
        Reduced(run.coherent_image(), run.require_track(), self.parameters.sub_aperture).fill(self.store)

    def _rest(self, index: BagIndex | None, first: list[str]) -> None:
        try:
            self._guarded("grid", self._grid)
            self._guarded("objects", self._further_objects)
            self._guarded("views", lambda: self._views(index, first))
            self._guarded("composites", self._composites)
            self._guarded("truth", self._truth)
            self._guarded("shape", self._shape)
            if self.failed:
                self.store.put_part("status", self.failed)
        finally:
            for line in self._reader.problems:
                self._problem(line)
            self.store.put_part("progress", {"state": "done"})
            self.store.loaded.set()
            self.done.set()

    def _views(self, index: BagIndex | None, first: list[str]) -> None:
        for name in self._held:
            if index is None:
                for view in self._sequential(name):
                    self.store.put_view(name, spooled(self._spool, name, view))
            elif name not in first:
                for _ in self._register(index, name):
                    pass

    def _shape(self) -> None:
        from .derived import Shape  # late: compiles kernels; the first picture is there by now

        shape = Shape(self.store, replace(self.parameters.carving, threshold=0.0))
        measure = not self._report and not self._measured()
        for name in ("likelihood", "shadow_mask"):
            if measure or name == shape.other_stream:
                for entry in list(self.store.sets[name].values()):
                    shape.add(name, entry)
        shape.publish(measure=measure)

    def _measured(self) -> bool:
        """Show what the bag says of the target's dimensions; False if it says nothing."""
        said = False
        for _, message, _ in checked_messages(self._reader, "measurements", self._problem):
            try:
                objects = measurements_from_msg(message).objects
            except CsasError as error:
                self._problem(f"measurements: {error}")
                continue
            said = True
            self.store.put_dimensions(objects[0].dimensions if objects else None)
        return said

    def _sequential(self, name: str) -> Any:
        for pair in iterate_pairs(self._reader, name, self._problem):
            try:
                yield view_from_msgs(pair.image, pair.info, name)
            except CsasError as error:
                self._problem(error)

    def _grid(self) -> None:
        p = self.parameters.carving
        if self._folder is not None and (self._folder / "grid.npz").exists():
            grid = grid_of_folder(self._folder, str(self._report.get("method", p.method)))
            self.store.put_grid("main", grid, p.min_views_fraction)
            return
        found: dict[str, tuple[Volume, NDArray[np.float32]]] = {}
        for name in ("voxel_grid", "voxel_views"):
            for pair in iterate_pairs(self._reader, name, self._problem):
                _, volume, values = voxel_grid_from_msgs(pair.image, pair.info, name)
                found[name] = volume, values
        if "voxel_grid" in found:
            volume, likelihood = found["voxel_grid"]
            views = found.get("voxel_views", (volume, None))[1]
            self.store.put_grid("main", grid_of(volume, likelihood, views, p), p.min_views_fraction)

    def _composites(self) -> None:
        for name in ("multilook", "color_by_aspect"):
            for pair in iterate_pairs(self._reader, name, self._problem):
                info, pixels = ground_picture_from_msgs(pair.image, pair.info, name)
                shown = codes.amplitude_codes(pixels) if name == "multilook" else np.asarray(pixels)
                self.store.put_picture(name, info, shown)


__all__ = ["PathSource", "codes_of", "grid_of", "spooled"]
