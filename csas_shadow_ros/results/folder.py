"""The results folder: written whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..bags import BagReader
from ..core.errors import CsasError
from ..core.geometry import CoherentImage, Track, View
from ..core.mesh import measure, mesh_from_grid
from ..core.pipeline import ProcessedView
from ..core.shape.result import Result
from ..core.volume import Volume, VoxelGrid
from .bag import ResultBag
from .report import FORMAT, Context, build_report, report_text, summary
from .subject import Keeper, Subject
from .truth import score

if TYPE_CHECKING:
    import trimesh

REPORT = "report.json"
GRID = "grid.npz"
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


class ResultsError(CsasError):
    """A results folder cannot be written or read."""


class ResultsWriter:
    """Writes a results folder, beside its final place until it is complete.

    Views are written as they are made: memory does not grow with their number.

    Parameters
    ----------
    folder : path-like
        Folder to make.
    overwrite : bool
        Replace a results folder that is there. Anything else is never removed.
    bag, figures : bool
        Whether to write ``result.mcap`` and ``figures/``.

    Raises
    ------
    ResultsError
        If the folder is taken or cannot be made.
    """

    def __init__(
        self, folder: str | Path, *, overwrite: bool = False, bag: bool = True, figures: bool = True
    ) -> None:
        self.folder = Path(os.path.abspath(folder))
        self._overwrite = overwrite
        self._check_place()
        self._work = self.folder.with_name(f".{self.folder.name}.incomplete-{os.getpid()}")
        try:
            if self._work.exists():
                shutil.rmtree(self._work)
            self._work.mkdir(parents=True)
        except OSError as error:
            raise ResultsError(f"cannot make {self._work}: {error.strerror}") from error
        self._bag = ResultBag(self._work) if bag else None
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
        if self._work.exists():
            if self._bag is not None:
                with contextlib.suppress(CsasError, OSError):
                    self._bag.abandon()
            shutil.rmtree(self._work, ignore_errors=True)

    def _check_place(self) -> None:
        if not self.folder.exists():
            return
        if self.folder.is_dir():
            if not any(self.folder.iterdir()):
                return
            if not self._overwrite:
                raise ResultsError(
                    f"{self.folder} exists already; expected a new folder, or --overwrite (overwrite=True)"
                )
            if is_results_folder(self.folder):
                return
        raise ResultsError(f"{self.folder} is there and is no results folder: not replaced")

    def write_source(
        self, image: CoherentImage | None, track: Track | None, reader: BagReader | None = None
    ) -> None:
        """Write the image and the track to the bag; see `ResultBag.write_source`."""
        if self._bag is not None:
            self._bag.write_source(image, track, reader)

    def add_view(self, view: ProcessedView) -> None:
        """Take one processed view: the `on_view` of `pipeline.run` and `stages.run_views`."""
        start = time.perf_counter()
        self.show_view(view)
        for stream, attribute in _STREAMS.items():
            one: View | None = getattr(view, attribute)
            if one is None:
                continue
            if self._bag is not None:
                self._bag.write_view(one, stream)
        self.view_seconds += time.perf_counter() - start

    def show_view(self, view: ProcessedView) -> None:
        """Take one processed view for the figures alone."""
        self._keeper.add(view)

    def adopt_bag(self, recording: Path, *, whole: bool = False) -> None:
        """Take a recording of the node graph as ``result.mcap``; a whole one as it is."""
        if self._bag is not None:
            self._bag.adopt(recording, whole=whole)

    def finish(self, result: Result, context: Context) -> dict[str, Any]:
        """Write everything else and put the folder in its place.

        Parameters
        ----------
        result : Result
            What the method left.
        context : Context
            What it was run on.

        Returns
        -------
        dict
            The report.

        Raises
        ------
        ResultsError
            If the disk refuses.
        """
        try:
            report = self._write_all(result, context)
            self._put_in_place()
        except OSError as error:
            raise ResultsError(f"cannot write {self.folder}: {error}") from error
        return report

    def _write_all(self, result: Result, context: Context) -> dict[str, Any]:
        timings, start = context.timings_s, time.perf_counter()

        def lap(step: str) -> None:
            nonlocal start
            timings[step] = time.perf_counter() - start
            start = time.perf_counter()

        work = self._work
        write_grid(work / GRID, result.grid or _unknown_grid(result, context), result.matter)
        if result.mesh is not None:
            write_meshes(work, result.mesh)
        if result.matter_mesh is not None and result.matter_mesh is not result.mesh:
            _write_mesh(work / MATTER_MESH, result.matter_mesh)
        for number, one in enumerate(result.objects, start=1):
            if number > 1 or result.mesh is None:  # grid.npz and mesh.* are the target's
                write_grid(work / f"object_{number}.npz", one.grid)
                one.mesh.export(str(work / f"object_{number}.stl"))
        if self._bag is not None:
            self._bag.finish(result)
        lap("write")
        left_out: dict[str, str] = {"all": "not asked for"}
        truth = context.truth
        if self._figures:
            from .figures import draw_all  # late: what only looks at a folder needs no matplotlib

            subject = Subject(
                result,
                self._keeper,
                context.parameters,
                context.image,
                context.track,
                truth.mesh if truth is not None else None,
            )
            _, left_out = draw_all(subject, work / "figures")
            lap("figures")
        scores = None
        if truth is not None and truth.dimensions is not None and result.grid is not None and result.evidence:
            sonar = np.array([one.sonar_m for one in result.evidence.values()])
            scores = score(truth, result.grid, sonar, result.matter)
            lap("scores")
        other = result.other_grid
        other_dimensions = (
            measure(mesh_from_grid(other)) if other is not None and other.occupied.any() else None
        )
        files = [p.relative_to(work).as_posix() for p in work.rglob("*") if p.is_file()]
        report = build_report(
            result,
            context,
            scores=scores,
            other=other_dimensions,
            files=[*files, REPORT, "summary.txt"],
            figures_left_out=left_out,
        )
        (work / "summary.txt").write_text(summary(report), encoding="utf-8")
        (work / REPORT).write_text(report_text(report), encoding="utf-8")
        return report

    def _put_in_place(self) -> None:
        self._check_place()  # it may have been taken in the meantime
        old = self.folder.with_name(f".{self.folder.name}.replaced-{os.getpid()}")
        if self.folder.exists():
            self.folder.replace(old)
        self._work.replace(self.folder)
        shutil.rmtree(old, ignore_errors=True)


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


def write_meshes(folder: Path, mesh: trimesh.Trimesh) -> list[str]:
    """Write ``mesh.stl``, ``.ply``, ``.obj`` and ``.glb``; metres, scene frame, z up in all of them."""
    names = []
    for kind in MESH_FORMATS:
        path = folder / f"mesh.{kind}"
        _write_mesh(path, mesh)
        names.append(path.name)
    return names


def _write_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh in the format that the file's name ends with."""
    data: Any = mesh.export(file_type=path.suffix[1:])
    if isinstance(data, str):
        path.write_text(data, encoding="utf-8")
    else:
        path.write_bytes(data)


def is_results_folder(folder: str | Path) -> bool:
    """Say whether a folder holds results."""
    try:
        return bool(json.loads((Path(folder) / REPORT).read_text(encoding="utf-8")).get("format") == FORMAT)
    except (OSError, ValueError, AttributeError):
        return False


def read_report(folder: str | Path) -> dict[str, Any]:
    """Read the report of a results folder.

    Raises
    ------
    ResultsError
        If it is none.
    """
    if not is_results_folder(folder):
        raise ResultsError(f"{folder} is no results folder: it holds no {REPORT} of this package")
    report: dict[str, Any] = json.loads((Path(folder) / REPORT).read_text(encoding="utf-8"))
    return report
