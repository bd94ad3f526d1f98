"""The results folder: put in place whole, first without what may fail, then with it."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..bags import BagReader
from ..core.errors import CsasError
from ..core.geometry import CoherentImage, Track, View
from ..core.pipeline import ProcessedView
from ..core.shape.mesh import Dimensions, measure, mesh_from_grid
from ..core.shape.result import Result
from ..core.shape.volume import Volume, VoxelGrid
from ..durable import BY_HAND, CHECKSUMS, Place, write_checksums
from .bag import ResultBag
from .layout import GRID, REPORT, SUMMARY, ResultsError, is_results_folder
from .report import Context, build_report, complete_report, report_text, summary
from .subject import Keeper, Subject
from .truth import KnownTruth, of_nothing, of_objects, placed, score

if TYPE_CHECKING:
    import trimesh

T = TypeVar("T")

#: The surface of the matter alone, where echoes show a hollow.
MATTER_MESH = "mesh_matter.stl"
MESH_FORMATS = ("stl", "ply", "obj", "glb")
#: Streams of the bag, and where a processed view has them.
_STREAMS = {
    "sub_aperture": "sub_aperture",
    "shadow": "shadow",
    "likelihood": "likelihood",
    "shadow_mask": "mask",
}
#: Voxels a side of the grid that says that nothing is known, where there is no target.
_EMPTY_SIDE = 32


class ResultsWriter:
    """Writes a results folder, beside its final place until it is whole.

    Views are written as they are made: memory does not grow with their number. Grid, meshes, bag and report
    are put in place first; then figures and scores, with another report. Whatever of that fails costs nothing
    but itself, and is named in the report's ``failed``; without a grid there is no folder.

    Parameters
    ----------
    folder : path-like
        Folder to make.
    overwrite : bool
        Replace a results folder that is there. Anything else is never removed.
    bag, figures : bool
        Whether to write ``result.mcap`` and ``figures/``.
    durable : bool
        Write the folder out to the disk before it is in place, so that a power cut does not cost it.
    notice : callable
        Called with each line that a user should see.

    Raises
    ------
    ResultsError
        If the folder is taken or cannot be made.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        overwrite: bool = False,
        bag: bool = True,
        figures: bool = True,
        durable: bool = True,
        notice: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.folder = Path(os.path.abspath(folder))  # noqa: PTH100  (a link stays one)
        self._overwrite, self._durable = overwrite, durable
        self._place = Place(self.folder)
        self._place.clear(notice)
        self._check_place()
        #: Why what is not there is not, by what it is.
        self.failed: dict[str, str] = {}
        try:
            self._work = self._place.make()
        except OSError as error:
            raise ResultsError(f"cannot make {self._place.work}: {error.strerror}") from error
        self._bag = self.attempt(ResultBag.FILE, lambda: ResultBag(self._work), None) if bag else None
        self._figures = figures
        self._keeper = Keeper()
        #: Where things may lie that are moved or removed before the folder is finished.
        self.work = self._work
        #: Seconds spent in writing views.
        self.view_seconds = 0.0

    def __enter__(self) -> ResultsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._work.exists() and self._bag is not None:
            with contextlib.suppress(CsasError, OSError):
                self._bag.abandon()
        self._place.abandon()

    def attempt(self, part: str, make: Callable[[], T], otherwise: T) -> T:
        """Make a part of the result; if it fails, note why, and go on without.

        Parameters
        ----------
        part : str
            What it is, as the report names it.
        make : callable
            Makes it.
        otherwise
            Taken where it cannot be made.
        """
        try:
            return make()
        except Exception as error:  # whatever it is, the grid is not to be lost for it
            kind = "" if isinstance(error, CsasError | OSError) else f"{type(error).__name__}: "
            self.failed.setdefault(part, f"{kind}{' '.join(str(error).split())}" or type(error).__name__)
            return otherwise

    def _to_bag(self, write: Callable[[ResultBag], object]) -> None:
        """Write something to the bag; one that cannot be written is given up, for good."""
        bag = self._bag
        if bag is None:
            return
        self.attempt(ResultBag.FILE, lambda: write(bag), None)
        if ResultBag.FILE in self.failed:
            self._bag = None
            bag.discard()

    def _check_place(self) -> None:
        if not self.folder.exists():
            return
        if self.folder.is_dir():
            if not any(self.folder.iterdir()):
                return
            if not self._overwrite:
                raise ResultsError(
                    f"{self.folder} exists already; expected a new folder, or --overwrite"
                )
            if is_results_folder(self.folder):
                return
        raise ResultsError(f"{self.folder} exists and is not a results folder: not replaced")

    def write_source(
        self, image: CoherentImage | None, track: Track | None, reader: BagReader | None = None
    ) -> None:
        """Write the image and the track to the bag; see `ResultBag.write_source`."""
        self._to_bag(lambda bag: bag.write_source(image, track, reader))

    def add_view(self, view: ProcessedView) -> None:
        """Take one processed view: the `on_view` of `pipeline.run` and `later_stages.run_views`."""
        start = time.perf_counter()
        self.show_view(view)
        shown: list[tuple[str, View | None]] = [(s, getattr(view, name)) for s, name in _STREAMS.items()]

        def write(bag: ResultBag) -> None:
            for stream, one in shown:
                if one is not None:
                    bag.write_view(one, stream)

        self._to_bag(write)
        self.view_seconds += time.perf_counter() - start

    def show_view(self, view: ProcessedView) -> None:
        """Take one processed view for the figures alone."""
        self._keeper.add(view)

    def adopt_bag(self, recording: Path, *, whole: bool = False) -> None:
        """Take a recording of the node graph as ``result.mcap``; a whole one as it is."""
        self._to_bag(lambda bag: bag.adopt(recording, whole=whole))

    def finish(self, result: Result, context: Context) -> dict[str, Any]:
        """Put the grid and what goes with it in place, then figures and scores.

        Parameters
        ----------
        result : Result
            What the method left.
        context : Context
            What it was run on.

        Returns
        -------
        dict
            The report; what could not be made is in its ``failed``.

        Raises
        ------
        ResultsError
            If the disk refuses the grid, or the place is taken.
        """
        began = time.perf_counter()
        self.failed = {**context.failed, **self.failed}
        truth = context.truth
        if truth is not None and (extent := _extent(result, context)) is not None:
            voxel = context.parameters.carving.voxel_size_m
            known = truth
            truth = context.truth = self.attempt("truth", lambda: placed(known, extent, voxel), known)
        own: list[KnownTruth | None] = []
        if truth is not None:
            scene = truth
            own = self.attempt("truth", lambda: _own_truths(scene, result, context), own)
        mine = own[0] if own else None
        scored = mine is not None and mine.has_object and result.grid is not None and bool(result.evidence)
        to_come = (["figures"] if self._figures else []) + (["scores"] if scored else [])
        try:
            write_grid(self._work / GRID, result.grid or _unknown_grid(result, context), result.matter)
            self._write_surfaces(result)
            self._to_bag(lambda bag: bag.finish(result))
            other = self.attempt("other_method", lambda: _measured(result.other_grid), None)
            sums: dict[str, str] = {}
            context.timings_s["write"] = time.perf_counter() - began
            report = build_report(
                result,
                context,
                other=other,
                truths=own,
                figures_left_out={} if self._figures else {"all": "not asked for"},
                attempt=self.attempt,
            )
            self._commit(report, sums, dict.fromkeys(to_come, "the run ended before they were made"))
        except OSError as error:
            raise ResultsError(f"cannot write {self.folder}: {error}") from error
        if to_come:
            self._add_what_may_fail(report, sums, result, context, mine, scored=scored)
        return report

    def _write_surfaces(self, result: Result) -> None:
        work = self._work
        if (mesh := result.mesh) is not None:
            for kind in MESH_FORMATS:
                self._write_part(work / f"mesh.{kind}", mesh)
        if result.matter_mesh is not None and result.matter_mesh is not mesh:
            self._write_part(work / MATTER_MESH, result.matter_mesh)
        for number, one in enumerate(result.objects, start=1):
            if number > 1 or mesh is None:  # grid.npz and mesh.* are the target's
                path, grid = work / f"object_{number}.npz", one.grid
                self.attempt(path.name, lambda p=path, g=grid: write_grid(p, g), None)  # type: ignore[misc]
                self._remove_failed(path)
                self._write_part(work / f"object_{number}.stl", one.mesh)

    def _write_part(self, path: Path, mesh: trimesh.Trimesh) -> None:
        self.attempt(path.name, lambda: _write_mesh(path, mesh), None)
        self._remove_failed(path)

    def _remove_failed(self, path: Path) -> None:
        """Remove what there is of a file that could not be written to its end."""
        if path.name in self.failed:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)

    def _add_what_may_fail(
        self,
        report: dict[str, Any],
        sums: dict[str, str],
        result: Result,
        context: Context,
        truth: KnownTruth | None,
        *,
        scored: bool,
    ) -> None:
        """Draw figures and score, then put the folder in place again; it is there whatever happens here."""
        timings = context.timings_s
        try:
            work = self._work = self._place.copy_back(REPORT, SUMMARY, CHECKSUMS)
        except OSError as error:
            self.failed["figures and scores"] = str(error)
            report["failed"] = dict(self.failed)
            return
        left_out: dict[str, str] = {} if self._figures else {"all": "not asked for"}
        if self._figures:
            began = time.perf_counter()
            left_out = self.attempt(
                "figures", lambda: self._draw(result, context, truth, work), {"all": "see failed"}
            )
            timings["figures"] = time.perf_counter() - began
        scores = None
        if scored and truth is not None and result.grid is not None:
            began, grid, known = time.perf_counter(), result.grid, truth
            sonar = np.array([one.sonar_m for one in result.evidence.values()])
            scores = self.attempt("scores", lambda: score(known, grid, sonar, result.matter), None)
            timings["scores"] = time.perf_counter() - began
        complete_report(report, result, context, scores=scores, figures_left_out=left_out)
        try:
            self._commit(report, sums, {})
        except (OSError, ResultsError) as error:
            # What is in place is whole, and says of itself that these are missing.
            self.failed["figures and scores"] = f"cannot be put in place: {error}"
            report["failed"] = dict(self.failed)

    def _draw(
        self, result: Result, context: Context, truth: KnownTruth | None, work: Path
    ) -> dict[str, str]:
        from .figures import draw_all  # late: what only looks at a folder needs no matplotlib

        subject = Subject(
            result,
            self._keeper,
            context.parameters,
            context.image,
            context.track,
            truth.mesh if truth is not None and not truth.unusable else None,
        )
        _, left_out, failed = draw_all(subject, work / "figures")
        self.failed.update(failed)
        return left_out

    def _commit(self, report: dict[str, Any], sums: dict[str, str], to_come: dict[str, str]) -> None:
        """Write the report, the table and the checksums, and put the folder in place."""
        files = {p.relative_to(self._work).as_posix() for p in self._work.rglob("*") if p.is_file()}
        report["files"] = sorted({*files, REPORT, SUMMARY, CHECKSUMS} - set(BY_HAND))
        report["failed"] = {**self.failed, **to_come}
        text = self.attempt(SUMMARY, lambda: summary(report), "")
        report["failed"] = {**self.failed, **to_come}
        for name, content in ((SUMMARY, text), (REPORT, report_text(report))):
            (self._work / name).write_text(content, encoding="utf-8")
            sums.pop(name, None)
        write_checksums(self._work, sums)
        ours = self._place.is_ours()
        if not ours:
            self._check_place()  # it may have been taken in the meantime
        self._place.put(replace=self._overwrite or ours, durable=self._durable)


def _extent(result: Result, context: Context) -> tuple[float, float, float, float] | None:
    """Return left, right, bottom and top of what was imaged, or round what was carved; None: nobody knows."""
    if context.image is not None:
        return context.image.grid.extent_m
    if result.composites is not None:
        return result.composites.grid.extent_m
    if result.grid is None:
        return None
    (x, y, _), (length, width, _) = result.grid.volume.centre_m, result.grid.volume.size_m
    return x - length, x + length, y - width, y + width


def _own_truths(truth: KnownTruth, result: Result, context: Context) -> list[KnownTruth | None]:
    """Return what the target is in truth, then each further object."""
    voxel, found = context.parameters.carving.voxel_size_m, [one.dimensions for one in result.objects]
    own = of_objects(truth, found, voxel)
    return own if result.mesh is not None else [of_nothing(truth, voxel), *own]


def _measured(grid: VoxelGrid | None) -> Dimensions | None:
    return measure(mesh_from_grid(grid)) if grid is not None and grid.occupied.any() else None


def write_grid(path: Path, grid: VoxelGrid, matter: NDArray[np.bool_] | None = None) -> None:
    """Write ``grid.npz``: likelihood, occupied, views (nz, ny, nx), origin_m, voxel_size_m, threshold.

    And ``matter`` (nz, ny, nx): where no echo was looked at, all that is occupied.
    """
    np.savez_compressed(
        path,
        likelihood=grid.likelihood.astype(np.float32, copy=False),
        occupied=grid.occupied.astype(bool, copy=False),
        matter=(grid.occupied if matter is None else matter).astype(bool, copy=False),
        views=grid.views,
        origin_m=np.asarray(grid.volume.origin_m, dtype=np.float64),
        voxel_size_m=np.float64(grid.volume.voxel_size_m),
        threshold=np.float64(grid.threshold),
    )


def _unknown_grid(result: Result, context: Context) -> VoxelGrid:
    """Make the grid of a scene without a target: one layer over the image, of which nothing is known.

    A reader of ``grid.npz`` then always finds a grid, and in this one nothing occupied.
    """
    ground = context.image.grid if context.image is not None else None
    if ground is None and result.composites is not None:
        ground = result.composites.grid
    left, right, bottom, top = ground.extent_m if ground is not None else (-1.0, 1.0, -1.0, 1.0)
    voxel = max(max(right - left, top - bottom) / _EMPTY_SIDE, context.parameters.carving.voxel_size_m)
    middle = ((left + right) / 2, (bottom + top) / 2)
    volume = Volume.around(middle, (right - left, top - bottom, voxel), voxel)
    unknown = np.full(volume.shape, np.nan, np.float32)
    nothing = np.zeros(volume.shape, np.uint16)
    return VoxelGrid(volume, unknown, nothing, float("nan"), nothing.astype(bool))


def _write_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh in the format that the file's name ends with."""
    data: Any = mesh.export(file_type=path.suffix[1:])
    if isinstance(data, str):
        path.write_text(data, encoding="utf-8")
    else:
        path.write_bytes(data)
