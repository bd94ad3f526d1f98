"""What there is to see: views by set and aspect, composites, volumes, track, dimensions."""

from __future__ import annotations

import json
import math
import tempfile
import threading
import uuid
import weakref
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.camera_info import GroundInfo

from ..core.errors import CsasError
from ..core.geometry import Track, ViewInfo
from ..core.parameters import CarvingParameters
from ..core.shape.mesh import Dimensions
from ..core.shape.threshold import needed_threshold, well_seen_voxels
from ..core.shape.volume import VoxelGrid
from . import codes
from .codes import LOW_DB, STEP_DB, Codes

if TYPE_CHECKING:
    import trimesh

#: Sets of views, and how they are shown.
SETS = {
    "sub_aperture": "amplitude",
    "shadow": "amplitude",
    "reduced": "amplitude",
    "likelihood": "likelihood",
    "shadow_mask": "mask",
}
#: Encoded pictures that are kept to be asked for again (bytes).
_CACHE_BYTES = 256 << 20
#: Two views of one set nearer than this (rad) with different stamps are of different runs.
_SAME_ASPECT_RAD = 1e-7
_TRACK_POSES = 720


#: What the names of a second run's sets, volumes and pictures begin with, where two are compared.
SECOND = "b."


def kind_of(name: str) -> str:
    """Return how a set of views is shown; a second run's as the first one's."""
    return SETS.get(name.removeprefix(SECOND), "")


class ViewerError(CsasError):
    """What is to be viewed is not there."""


@dataclass(frozen=True, eq=False)
class Entry:
    """A view that can be shown.

    Parameters
    ----------
    info : ViewInfo
        Where it looks.
    revision : str
        Changes when the pixels do.
    load : callable
        Gives its codes (amplitude, likelihood) or values (mask), shape (rows, cols).
    """

    info: ViewInfo
    revision: str
    load: Callable[[], Codes]

    def as_json(self) -> dict[str, Any]:
        """Return what the page needs to know."""
        info = self.info
        camera = info.camera
        return {
            "stamp": str(info.stamp_ns),
            "aspect_deg": math.degrees(info.aspect_rad) % 360.0,
            "rev": self.revision,
            "P": camera.projection.ravel().tolist(),
            "A": camera.ground_to_pixel.ravel().tolist(),
            "rows": camera.rows,
            "cols": camera.cols,
            "sonar": camera.sonar_m.tolist(),
            "grazing_deg": math.degrees(camera.grazing_rad),
            "aperture_deg": math.degrees(info.aperture_rad),
        }


class Spool:
    """Keeps codes on disk, compressed: memory does not grow with the number of views."""

    def __init__(self) -> None:
        # Open as long as the spool.
        self._file = tempfile.TemporaryFile(prefix="csas_viewer_")  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._lock = threading.Lock()
        self._end = 0

    def put(self, pixels: Codes) -> Callable[[], Codes]:
        """Keep an array; return what reads it back."""
        data, shape = zlib.compress(pixels.tobytes(), 1), pixels.shape
        with self._lock:
            at = self._end
            self._file.seek(at)
            self._file.write(data)
            self._end += len(data)

        def load() -> Codes:
            with self._lock:
                self._file.seek(at)
                packed = self._file.read(len(data))
            return np.frombuffer(zlib.decompress(packed), np.uint8).reshape(shape)

        return load


@dataclass(eq=False)
class ViewStore:
    """Everything that can be seen of a run, and who is to be told of what is new.

    Any thread may put and get. Listeners are called with one JSON-ready notice each, in the thread that puts.
    """

    title: str = ""
    live: bool = False
    listeners: list[Callable[[dict[str, Any]], None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        #: Which store this is: another one (a restarted viewer) may hold another run.
        self.instance = uuid.uuid4().hex[:12]
        #: Makes the reduced sub-apertures once they are asked for; None where there is no image.
        self.make_reduced: Callable[[], None] | None = None
        self._cache: OrderedDict[tuple[str, ...], bytes] = OrderedDict()
        self._cached = 0
        #: Set once all is there that will be; a live run goes on for ever.
        self.loaded = threading.Event()
        #: Where judgements are kept; None where there is no results folder.
        self.desk: Any = None
        self._clear()

    def _clear(self) -> None:
        self.sets: dict[str, dict[int, Entry]] = {name: {} for name in SETS}
        self.pictures: dict[str, tuple[GroundInfo, str, NDArray[np.uint8]]] = {}
        self.grids: dict[str, VoxelGrid] = {}
        self._parts: dict[str, Any] = {
            "track": [],
            "target": None,
            "dimensions": None,
            "truth": None,
            "pictures": {},
            "volumes": {},
            "status": "",
            "damage": "",
            "reduced": False,
            "contacts": [],
            "report": None,
            "progress": None,
            "desk": {"why": "judgements need a results folder", "revision": 0, "items": {}},
            "meshes": {},
            "other": None,
        }
        self._mesh_bytes: dict[str, bytes] = {}
        self._volume_bytes: dict[str, bytes] = {}

    def _tell(self, notice: dict[str, Any]) -> None:
        for listener in list(self.listeners):
            listener(notice)

    def reset(self, *, keep: tuple[str, ...] = ()) -> None:
        """Forget the run: another one begins; `keep` names the parts that are the new one's already."""
        with self.lock:
            kept = {name: self._parts[name] for name in keep}
            self._clear()
            self._parts |= kept
            self._tell({"type": "all", "scene": self.scene()})

    def scene(self) -> dict[str, Any]:
        """Return everything but pixels, as the page gets it when it connects."""
        with self.lock:
            sets = {
                name: {"kind": kind_of(name), "views": [e.as_json() for e in entries.values()]}
                for name, entries in self.sets.items()
            }
            about = {"instance": self.instance, "title": self.title, "live": self.live}
            return about | {"codes": {"low_db": LOW_DB, "step_db": STEP_DB}, "sets": sets} | self._parts

    def put_view(self, name: str, entry: Entry) -> None:
        """Add a view, or replace the one of its stamp; a view of another run clears the store first."""
        with self.lock:
            views = self.sets.setdefault(name, {})
            stamp, aspect = entry.info.stamp_ns, entry.info.aspect_rad
            known = views.get(stamp)
            if known is not None and known.revision == entry.revision:
                return
            if known is None and any(
                abs(math.remainder(e.info.aspect_rad - aspect, math.tau)) < _SAME_ASPECT_RAD
                for e in views.values()
            ):
                self.reset(keep=("track", "target", "reduced"))
            self.sets[name][stamp] = entry
            self._tell({"type": "view", "set": name, "view": entry.as_json()})

    def put_part(self, name: str, value: Any) -> None:
        """Set one of the small parts of the scene."""
        with self.lock:
            if self._parts[name] != value:
                self._parts[name] = value
                self._tell({"type": "part", "part": name, "value": value})

    def put_track(self, track: Track) -> None:
        """Set the track; at most `_TRACK_POSES` of its poses are shown."""
        step = max(1, len(track) // _TRACK_POSES)
        self.put_part("track", np.round(track.positions_m[::step], 4).tolist())

    def put_picture(self, name: str, info: GroundInfo, pixels: NDArray[np.uint8]) -> None:
        """Set a composite: codes (rows, cols), or RGB."""
        with self.lock:
            revision = f"{zlib.crc32(pixels.tobytes()):08x}"
            self.pictures[name] = info, revision, pixels
            grid = info.grid
            about = {
                "rev": revision,
                "rows": grid.rows,
                "cols": grid.cols,
                "A": grid.ground_to_pixel.ravel().tolist(),
            }
            self.put_part("pictures", self._parts["pictures"] | {name: about})

    def put_grid(self, name: str, grid: VoxelGrid, min_views_fraction: float | None = None) -> None:
        """Set a volume: ``main`` (what was carved) or ``other`` (the other kind of method)."""
        if min_views_fraction is None:
            min_views_fraction = CarvingParameters().min_views_fraction
        well_seen = well_seen_voxels(grid.views, grid.method, min_views_fraction)
        needed = needed_threshold(grid.likelihood, grid.method, well_seen)
        data = volume_codes(needed).tobytes()
        revision = f"{zlib.crc32(data):08x}"
        about = {
            "rev": revision,
            "shape": list(grid.volume.shape),
            "origin": list(grid.volume.origin_m),
            "voxel": grid.volume.voxel_size_m,
            "method": grid.method,
            "threshold": None if math.isnan(grid.threshold) else grid.threshold,
        }
        with self.lock:
            self.grids[name] = grid
            self._volume_bytes[name] = data
            self.put_part("volumes", self._parts["volumes"] | {name: about})

    def put_mesh(self, name: str, mesh: trimesh.Trimesh) -> None:
        """Set a surface that is shown over the carved one: the truth."""
        data = json.dumps(
            {"points": np.round(mesh.vertices, 4).ravel().tolist(), "faces": mesh.faces.ravel().tolist()}
        ).encode()
        with self.lock:
            self._mesh_bytes[name] = data
            about = {"rev": f"{zlib.crc32(data):08x}"}
            self.put_part("meshes", self._parts["meshes"] | {name: about})

    def mesh(self, name: str) -> bytes:
        """Return a surface as JSON: points (x, y, z, …) and faces (a, b, c, …)."""
        with self.lock:
            if name not in self._mesh_bytes:
                raise ViewerError(f"there is no surface {name!r}")
            return self._mesh_bytes[name]

    def put_desk(self, document: Mapping[str, Any]) -> None:
        """Set what has been judged, and that it can be."""
        with self.lock:
            if document["revision"] >= self._parts["desk"]["revision"]:  # two answers may overtake each other
                told = {"why": "", "revision": document["revision"], "items": document["items"]}
                self.put_part("desk", told)

    def put_dimensions(self, found: Dimensions | Mapping[str, Any] | None) -> None:
        """Set the dimensions with their 95 % intervals."""
        if isinstance(found, Dimensions):
            from ..results.layout import json_ready

            found = json_ready(found)
        self.put_part("dimensions", found)

    def volume(self, name: str) -> bytes:
        """Return a volume's codes, (nz, ny, nx) bytes."""
        with self.lock:
            if name not in self._volume_bytes:
                raise ViewerError(f"there is no volume {name!r}")
            return self._volume_bytes[name]

    def entry(self, name: str, stamp_ns: int) -> Entry:
        """Return a view."""
        with self.lock:
            found = self.sets.get(name, {}).get(stamp_ns)
        if found is None:
            raise ViewerError(f"there is no view {name}/{stamp_ns}")
        return found

    def view_picture(self, name: str, stamp_ns: int, kind: str) -> bytes:
        """Return a view's picture, as ``jpg`` or ``png``."""
        entry = self.entry(name, stamp_ns)
        return self._cached_bytes(
            (name, str(stamp_ns), entry.revision, kind),
            lambda: codes.picture(codes.shown(entry.load(), kind_of(name)), kind),
        )

    def composite_picture(self, name: str) -> bytes:
        """Return a composite as PNG."""
        with self.lock:
            if name not in self.pictures:
                raise ViewerError(f"there is no composite {name!r}")
            _, revision, pixels = self.pictures[name]
        return self._cached_bytes((name, revision), lambda: codes.picture(pixels, "png"))

    def contour(self, stamp_ns: int, name: str = "shadow_mask") -> list[list[float]]:
        """Return the outline of a view's segmented shadow."""
        if kind_of(name) != "mask":
            raise ViewerError(f"{name[:40]!r} is not a set of masks")
        return codes.contour(self.entry(name, stamp_ns).load())

    def _cached_bytes(self, key: tuple[str, ...], make: Callable[[], bytes]) -> bytes:
        with self.lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        made = make()
        with self.lock:
            if key not in self._cache:
                self._cache[key] = made
                self._cached += len(made)
            while self._cached > _CACHE_BYTES:
                self._cached -= len(self._cache.popitem(last=False)[1])
        return made


def volume_codes(needed: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Code the threshold that a voxel needs to be object: 254 times its root; 255 never."""
    finite = np.isfinite(needed)
    code = np.rint(254.0 * np.sqrt(np.where(finite, np.clip(needed, 0.0, 1.0), 0.0)))
    return np.where(finite, code, 255).astype(np.uint8)


__all__ = ["SETS", "Entry", "Spool", "ViewStore", "ViewerError", "volume_codes"]
