"""A bag in, a results folder out, in one process."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .bags import BagReader, Problem, Run, read_run
from .bags.metadata import read_metadata
from .bags.pairs import first_of_alike
from .bags.run import sectors_of_one_run
from .core.errors import BagError, CsasError, check_type
from .core.geometry import CoherentImage, Track
from .core.geometry.arcs import Arc, Arcs
from .core.later_stages import STAGES
from .core.parameters import MAX_OBJECTS, PipelineParameters
from .from_bag import (
    Notice,
    Progress,
    Source,
    choose_start,
    ignore,
    reconstruct_run,
    refuse_contradictions,
    tell_of_sectors,
)
from .results import Context, ResultsWriter

if TYPE_CHECKING:
    from .graph.replay import ReplayResult


def process_bag(
    bag: str | Path,
    out: str | Path,
    parameters: PipelineParameters | None = None,
    *,
    start_from: str = "auto",
    spectrum_sign: int | None = None,
    namespace: str | None = None,
    run_of_bag: int | None = None,
    overwrite: bool = False,
    write_bag: bool = True,
    figures: bool = True,
    durable: bool = True,
    workers: int = 2,
    max_objects: int = MAX_OBJECTS,
    command: Sequence[str] = (),
    progress: Progress | None = None,
    notice: Notice = ignore,
) -> dict[str, Any]:
    """Reconstruct what a bag shows and write its results folder.

    Parameters
    ----------
    bag : path-like
        A rosbag2 directory or a lone storage file.
    out : path-like
        Results folder to make.
    parameters : PipelineParameters
        Parameters of every stage.
    start_from : str
        ``image`` (or sectors) with the track, views of a stage, or ``auto``: the first that is there.
    spectrum_sign : int, optional
        +1 or -1 instead of what the bag states; said in a notice and in the report.
    namespace : str, optional
        Namespace of the topics; found by itself if not given.
    run_of_bag : int, optional
        Which of several runs of the bag, as in `read_run`.
    overwrite, write_bag, figures, durable
        See `ResultsWriter`.
    workers : int
        Threads.
    max_objects : int
        At most so many bodies are carved, the target among them (see `pipeline.run`). Shadow views and what
        follows them were made for one target.
    command : sequence of str
        Command line, for the report.
    progress : callable, optional
        Called with (views done, views in all).
    notice : callable
        Called with each line that a user should see.

    Returns
    -------
    dict
        The report.

    Raises
    ------
    CsasError
        If the bag, a parameter or the folder is not usable.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> chosen = csas.parameters(step_deg=15)
    >>> report = csas.process_bag("box_run", "box_results", chosen, figures=False)
    >>> report["verdict"]
    'object'
    """
    check_type("bag", bag, (str, os.PathLike), "the path of a bag")
    check_type("out", out, (str, os.PathLike), "the path of a results folder")
    p = parameters or PipelineParameters()
    with ResultsWriter(
        out, overwrite=overwrite, bag=write_bag, figures=figures, durable=durable, notice=notice
    ) as writer:
        began = time.perf_counter()
        run = read_run(bag, namespace, run_of_bag)
        context = Context(p, command, spectrum_sign_override=spectrum_sign)
        context.read_truth(bag)

        def take_source(source: Source) -> None:
            context.stage, context.image, context.track = source.stage, source.image, source.track
            context.timings_s["read"] = time.perf_counter() - began
            reader = BagReader(run.path, run.namespace) if source.as_recorded else None
            writer.write_source(source.image, source.track, reader)

        result = reconstruct_run(
            run,
            p,
            start_from=start_from,
            spectrum_sign=spectrum_sign,
            workers=workers,
            max_objects=max_objects,
            on_source=take_source,
            on_view=writer.add_view,
            progress=progress,
            notice=notice,
        )
        context.timings_s["write_views"] = writer.view_seconds
        result.timings_s["views"] = max(result.timings_s.get("views", 0.0) - writer.view_seconds, 0.0)
        context.problems = told_once(run.problems)
        for line in context.problems:
            notice(f"problem: {line}")
        context.describe(lambda: describe_run(run))
        return writer.finish(result, context)


def replay_bag(
    bag: str | Path,
    out: str | Path,
    parameters: PipelineParameters | None = None,
    *,
    start_from: str = "auto",
    rate: float = 0.0,
    domain_id: int | None = None,
    namespace: str | None = None,
    run_of_bag: int | None = None,
    max_objects: int = MAX_OBJECTS,
    overwrite: bool = False,
    write_bag: bool = True,
    figures: bool = True,
    durable: bool = True,
    command: Sequence[str] = (),
    progress: Progress | None = None,
    notice: Notice = ignore,
    viewer_port: int | None = None,
    without: Sequence[str] = (),
) -> dict[str, Any]:
    """Reconstruct the target of a bag through the node graph and write the same results folder.

    Parameters
    ----------
    bag, out, parameters, start_from, namespace, run_of_bag, max_objects, overwrite, write_bag, figures
    durable, command, progress, notice
        See `process_bag`.
    rate : float
        Views: times the recorded speed; 0: as fast as the nodes take them.
    domain_id : int, optional
        ROS domain, to look on with other tools; a free one otherwise.
    viewer_port : int, optional
        Show the graph in the operator's page, at this port of this machine.
    without : sequence of str
        Nodes that are not started, as a node of your own takes their place: see `graph.replay.replay`.

    Returns
    -------
    dict
        The report, and as ``not_recorded`` what of the run its bag lacks. The nodes' logs are in the
        folder's ``log/``.

    Raises
    ------
    CsasError
        As `process_bag`; and if ROS 2 is not there, or the graph does not get to its end.
    """
    from .results.recording import adopt_replay

    _require_ros()
    from .graph.replay import replay

    p = parameters or PipelineParameters()
    with ResultsWriter(
        out, overwrite=overwrite, bag=write_bag, figures=figures, durable=durable, notice=notice
    ) as writer:
        began = time.perf_counter()
        run = read_run(bag, namespace, run_of_bag)
        context = Context(p, command)
        context.read_truth(bag)
        image, stage = _image_to_play(run, start_from, notice)
        context.timings_s["read"] = time.perf_counter() - began
        scratch = writer.work / ".replay"
        replayed = replay(
            bag,
            scratch,
            p,
            stage=stage,
            namespace=run.namespace,
            rate=rate,
            domain_id=domain_id,
            record=True,
            max_objects=max_objects,
            overrides=_of_player_and_recorder(run),
            progress=progress or False,
            notice=notice,
            beside=None if viewer_port is None else _viewer(viewer_port, p),
            without=without,
        )
        _take_replay(context, replayed, run, image)
        result = adopt_replay(writer, replayed, p, whole=rate == 0.0)
        writer.attempt("log", lambda: (scratch / "log").rename(writer.work / "log"), None)
        shutil.rmtree(scratch, ignore_errors=True)
        context.describe(lambda: describe_run(run))
        report = writer.finish(result, context)
        return report | {"not_recorded": replayed.not_recorded} if write_bag else report


def _require_ros() -> None:
    """Say in one line where ROS 2 is not there."""
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise CsasError(
            f"replay needs ROS 2, which is not there ({error}); source it, or pip install"
            " 'csas_shadow_ros[ros]', or use `csas-shadow run`"
        ) from error


def _image_to_play(run: Run, start_from: str, notice: Notice) -> tuple[CoherentImage | None, str]:
    """Return the image that the graph is to make views of, None where it starts from views; and the stage."""
    if choose_start(run, start_from) != "image":
        return None, start_from
    image = run.coherent_image()
    refuse_contradictions(image, run.require_track(), notice, run)
    if run.image is not None:
        return image, start_from
    tell_of_sectors(run, notice)
    return image, "sector"  # also where there is an image that cannot be used


def _of_player_and_recorder(run: Run) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes that play the run and record the graph."""
    return {
        # The results folder that takes the recording is written out to the disk as a whole.
        "bag_recorder": {"compression": "lz4", "sync": False},
        "bag_player": {} if run.run_ns is None else {"run": run.run_ns},
    }


def _viewer(port: int, parameters: PipelineParameters) -> dict[str, dict[str, Any]]:
    """Return the node that shows the graph, with its parameters."""
    return {"viewer": {"port": port, "method": parameters.carving.method}}


def _take_replay(context: Context, replayed: ReplayResult, run: Run, image: CoherentImage | None) -> None:
    """Put into the context what the graph says of its run, besides the result."""
    from .results.recording import node_table, unplaced

    context.stage = "image" if replayed.stage == "sector" else replayed.stage
    if context.stage == "image":
        context.image = image
    context.track = run.track
    context.nodes, context.views_lost = node_table(replayed), replayed.lost
    context.views_in = replayed.views_total
    context.problems = [*told_once(run.problems), *unplaced(replayed)]
    context.problems += [f"the recording is not whole: {line}" for line in replayed.not_recorded]


def told_once(problems: Sequence[Problem]) -> list[str]:
    """Return problems as lines; what is wrong with many messages alike is one line."""
    return [f"{first}{more}" for first, more in first_of_alike(problems, lambda p: (p.topic, p.reason))]


def describe_image(image: CoherentImage) -> dict[str, Any]:
    """Return an image's size and band."""
    grid, acoustics = image.grid, image.acoustics
    return {
        "rows": grid.rows,
        "cols": grid.cols,
        "spacing_m": grid.spacing_m,
        "extent_m": {
            "left": grid.extent_m[0],
            "right": grid.extent_m[1],
            "bottom": grid.extent_m[2],
            "top": grid.extent_m[3],
        },
        "centre_frequency_hz": acoustics.centre_frequency_hz,
        "bandwidth_hz": acoustics.bandwidth_hz,
        "sound_speed_mps": acoustics.sound_speed_mps,
        "spectrum_sign": acoustics.spectrum_sign,
        "stamp_ns": image.stamp_ns,
    }


def describe_track(track: Track) -> dict[str, Any]:
    """Return a track's size, circle and coverage."""
    x, y, radius, height = track.circle
    return {
        "poses": len(track),
        "centre_m": [x, y],
        "radius_m": radius,
        "height_m": height,
        "grazing_deg": math.degrees(track.grazing_rad),
        "coverage_deg": math.degrees(track.coverage_rad),
        "gaps": [str(gap) for gap in track.gaps],
        "duration_s": float(track.stamps_ns[-1] - track.stamps_ns[0]) * 1e-9,
        "direction": "counter-clockwise" if track.aspects_rad[-1] > track.aspects_rad[0] else "clockwise",
    }


def describe_run(run: Run) -> dict[str, Any]:
    """Describe a bag: its topics with counts, its files, image, band and track.

    Returns
    -------
    dict
        Ready for JSON.
    """
    reader = BagReader(run.path, run.namespace)
    files = [run.path] if run.path.is_file() else sorted(p for p in run.path.iterdir() if p.is_file())
    track = run.track
    return {
        "path": str(run.path.resolve()),
        "namespace": run.namespace,
        "messages": reader.message_count,
        "topics": {
            name: {"type": info.type_name, "messages": info.count}
            for name, info in sorted(reader.topics.items())
        },
        "files": {p.name: p.stat().st_size for p in files},
        "bytes": sum(p.stat().st_size for p in files),
        "checksums": reader.has_checksums,
        "metadata": _bag_metadata(run.path),
        "image": None if run.image is None else describe_image(run.image),
        "sectors": describe_sectors(run),
        "track": None if track is None else describe_track(track),
    }


def describe_sectors(run: Run) -> dict[str, Any] | None:
    """Describe the sectors of a bag by what they say of themselves; None if there is none."""
    infos = run.sector_infos()
    if not infos:
        return None
    arcs = Arcs()
    for info in infos:
        arcs.add(Arc(info.aspect_rad - info.aperture_rad / 2.0, info.aperture_rad))
    first, (_, scene) = infos[0], sectors_of_one_run(infos)
    image = None
    if scene is not None:
        blank = np.broadcast_to(np.complex64(0), scene.shape)
        image = describe_image(CoherentImage(blank, scene, first.acoustics, first.stamp_ns))
    return {
        "count": len(infos),
        "covered_deg": math.degrees(arcs.covered_rad),
        "missing": [str(arc) for arc in arcs.missing()],
        "image": image,
    }


def _bag_metadata(path: Path) -> dict[str, Any] | None:
    """Return the bag's own metadata without its lists of topics, which are told elsewhere."""
    try:
        information = read_metadata(path).information
    except BagError:
        return None
    return {k: v for k, v in information.items() if k not in ("topics_with_message_count", "files")}


def topic_sizes(run: Run) -> dict[str, int]:
    """Return the bytes of the messages of each topic; reads the whole bag."""
    sizes: dict[str, int] = {}
    reader = BagReader(run.path, run.namespace)
    for message in reader.messages():
        sizes[message.topic] = sizes.get(message.topic, 0) + len(message.cdr)
    return sizes


def stages_of(run: Run) -> list[str]:
    """Return what a run of this bag could start from."""
    found: list[str] = []
    try:
        found.append(choose_start(run))
    except CsasError:
        return []
    return found + [stage for stage in STAGES if run.counts.get(stage) and stage not in found]
