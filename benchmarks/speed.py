"""How fast the chain is, and how time and memory grow: every bound is measured beside what it is relative to.

Simulates what it needs, measures ratios alternately in one run on this machine, prints a table and writes its
numbers and a figure::

    python benchmarks/speed.py                      # everything: docs/performance.json, docs/figures
    python benchmarks/speed.py --only chain carving # some parts
    python benchmarks/speed.py --work /tmp/bench    # keep simulated bags there, and use those that are there

Parts: fft (libraries), chain (against the literal reference, and its transforms alone), carving, graph,
samdis, streaming, growth. A part that was left out keeps the figures of the last run.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import ducc0
import numpy as np
import scipy.fft
import scipy.ndimage
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from csas_shadow_ros.bags import read_run
from csas_shadow_ros.core import reference
from csas_shadow_ros.core.geometry import (
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.imaging.enhancement import enhance
from csas_shadow_ros.core.imaging.likelihood import l_out, outside_likelihood, view_levels
from csas_shadow_ros.core.imaging.segmentation import require_silhouette, segment_shadow
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.shape.carving import Carver
from csas_shadow_ros.core.shape.volume import Target, Volume
from csas_shadow_ros.core.threads import in_order

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
OUT, FIGURE = ROOT / "docs" / "performance.json", ROOT / "docs" / "figures" / "performance_growth.png"
CORES = 2
#: The issue's grid: 128 × 128 × 64 voxels of 2 cm.
VOLUME_M = (2.56, 2.56, 1.28)
TARGET = Target((0.0, 0.0), VOLUME_M)
#: Rounds in which the two sides of a ratio take turns.
ROUNDS = 12
GRAPH_ROUNDS = 3
#: From this multiple of real time on, `benchmarks/streaming.py` asks that a run keeps up.
FAST_RATE = 4.0
SAMDIS_CIRCLE_S = 314.0

Report = dict[str, Any]


def simulated(work: Path, profile: str) -> Path:
    """Return a bag of a profile, simulated if it is not there yet."""
    bag = work / profile
    if not (bag / "metadata.yaml").exists():
        command = [sys.executable, "-m", "csas_shadow_ros.cli", "simulate", str(bag), "--profile", profile]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return bag


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Return wall and CPU seconds of a piece of work in this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def volume(voxels: float = 1.0) -> Volume:
    """Return the grid of the benchmark, with so many times 1 048 576 voxels of the same space."""
    step = 0.02 / voxels ** (1.0 / 3.0)
    return Volume.around(TARGET.position_m, VOLUME_M, step)


class Chain:
    """The default method from sub-aperture to grid, target given."""

    def __init__(self, image: CoherentImage, track: Track, spectrum: Spectrum | None = None) -> None:
        self.p = PipelineParameters()
        self.sub_apertures = SubApertures(image, track, self.p.sub_aperture, spectrum=spectrum)
        self.carver = Carver(volume(), self.p.carving)
        self.masks: list[View] = []

    def mask(self, aspect: float) -> View:
        """Take an aspect through all stages that precede carving."""
        p = self.p
        shadow = enhance(self.sub_apertures.view_of_aspect(aspect), TARGET.position_m, p.shadow)
        levels = view_levels(shadow, p.likelihood)
        outside_likelihood(shadow, p.likelihood, levels)
        reach_m = 0.55  # of a body as large as the simulated box
        return segment_shadow(shadow, TARGET.position_m, p.likelihood, levels, reach_m=reach_m)

    def run(self, aspects: Iterator[float] | list[float]) -> None:
        """Carve with some aspects, in two threads as the pipeline does."""
        for _, mask in in_order(self.mask, aspects, CORES):
            self.masks.append(mask)
            self.carver.integrate(require_silhouette(mask))


class Literal:
    """The same work, section by section of the paper: full-size transforms, one voxel as another."""

    def __init__(self, image: CoherentImage, sub_apertures: SubApertures) -> None:
        self.image, self.sub_apertures = image, sub_apertures
        v = volume()
        z, y, x = np.meshgrid(v.z_m, v.y_m, v.x_m, indexing="ij")
        self.points = np.stack([x, y, z], axis=-1)
        self.total = np.zeros(v.shape)
        self.count = np.zeros(v.shape, int)

    def view(self, aspect: float) -> None:
        """Take one aspect from the image to the grid."""
        image, info = self.image, self.sub_apertures.info(aspect)
        rows, cols, spacing = image.grid.rows, image.grid.cols, image.grid.spacing_m
        to_pixel = view_ground_to_pixel(aspect, spacing, rows, cols, image.grid.centre_m)
        camera = ShadowCamera.from_ground(to_pixel, info.camera.sonar_m, rows, cols)
        pixels = reference.sub_aperture(image, aspect, info.aperture_rad)
        view = reference.rotate_to_view(pixels, image, camera, aspect)
        focus_m = reference.focus_range(aspect, TARGET.position_m)
        amplitude = np.abs(reference.enhance(view, image, camera, aspect, focus_m)).astype(np.float32)
        level = np.median(amplitude[amplitude > 0]) / math.sqrt(2 * math.log(2))
        likelihood = l_out((amplitude / level) ** 2 / 2, 4.0)
        uv = camera.project(self.points)
        value = scipy.ndimage.map_coordinates(likelihood, [uv[..., 1], uv[..., 0]], order=1, cval=math.nan)
        known = np.isfinite(value)
        self.total[known] += value[known]
        self.count += known


def transforms(chain: Chain, aspects: list[float]) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return, for each aspect, the shapes of its 2-D transform and of its row transforms."""
    found = []
    for aspect in aspects:
        box, _ = chain.sub_apertures.baseband(aspect)
        info = chain.sub_apertures.info(aspect)
        behind = info.down_range_of_rows() > 0.0
        reach = math.ceil(
            info.down_range_of_rows().max() * math.tan(info.aperture_rad / 2) / info.camera.spacing_m[1]
        )
        length = scipy.fft.next_fast_len(info.camera.cols + min(reach, info.camera.cols))
        found.append((box.shape, (int(behind.sum()), length)))
    return found


def libraries() -> dict[str, tuple[Callable[..., Any], Callable[..., Any]]]:
    """Return the libraries that are there, as makers of transforms of a shape: 2-D inverse, rows forward."""

    def noise(shape: tuple[int, int]) -> Any:
        rng = np.random.default_rng(0)
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)

    def scipy_2d(shape: tuple[int, int]) -> Callable[[], object]:
        x = noise(shape)
        return lambda: scipy.fft.ifft2(x, workers=1)

    def scipy_rows(shape: tuple[int, int]) -> Callable[[], object]:
        x = noise(shape)
        return lambda: scipy.fft.fft(x, axis=1, workers=1)

    def ducc_2d(shape: tuple[int, int]) -> Callable[[], object]:
        x, y = noise(shape), noise(shape)
        return lambda: ducc0.fft.c2c(x, forward=False, out=y, nthreads=1)

    def ducc_rows(shape: tuple[int, int]) -> Callable[[], object]:
        x, y = noise(shape), noise(shape)
        return lambda: ducc0.fft.c2c(x, axes=(1,), out=y, nthreads=1)

    def cv_2d(shape: tuple[int, int]) -> Callable[[], object]:
        x = noise(shape).view(np.float32).reshape(*shape, 2)
        return lambda: cv2.dft(x, flags=cv2.DFT_INVERSE)

    def cv_rows(shape: tuple[int, int]) -> Callable[[], object]:
        x = noise(shape).view(np.float32).reshape(*shape, 2)
        return lambda: cv2.dft(x, flags=cv2.DFT_ROWS)

    found = {
        "scipy.fft": (scipy_2d, scipy_rows),
        "ducc0": (ducc_2d, ducc_rows),
        "OpenCV dft": (cv_2d, cv_rows),
    }
    try:
        import pyfftw
    except ImportError:
        return found

    def fftw(shape: tuple[int, int], axes: tuple[int, ...], direction: str) -> Callable[[], object]:
        x, y = (pyfftw.empty_aligned(shape, "complex64") for _ in range(2))
        plan = pyfftw.FFTW(x, y, axes=axes, direction=direction, flags=("FFTW_MEASURE",))
        x[:] = noise(shape)
        return lambda: plan.execute()

    found["pyFFTW"] = (
        lambda shape: fftw(shape, (0, 1), "FFTW_BACKWARD"),
        lambda shape: fftw(shape, (1,), "FFTW_FORWARD"),
    )
    return found


def fastest(shape: tuple[int, int], kind: int, repeats: int = 15) -> dict[str, float]:
    """Return the median milliseconds of each library for a transform, one thread."""
    makers = {name: pair[kind](shape) for name, pair in libraries().items()}
    times: dict[str, list[float]] = {name: [] for name in makers}
    for _ in range(repeats + 2):
        for name, work in makers.items():
            times[name].append(timed(work)[0])
    return {name: 1e3 * float(np.median(values[2:])) for name, values in times.items()}


def measure_fft(work: Path) -> Report:
    """Compare libraries on the transforms of the standard profile."""
    run = read_run(simulated(work, "standard"))
    chain = Chain(run.coherent_image(), run.require_track())
    box, rows = transforms(chain, [0.3])[0]
    return {
        "box": {"shape": box, "ms": fastest(box, 0)},
        "rows": {"shape": rows, "ms": fastest(rows, 1)},
    }


def measure_chain(work: Path) -> Report:
    """Time the chain in turns with the literal reference, and with its transforms alone."""
    cv2.setNumThreads(1)
    run = read_run(simulated(work, "standard"))
    image, track = run.coherent_image(), run.require_track()
    spectrum_s = [timed(lambda: Spectrum.of_image(image, CORES))[0] for _ in range(5)][2:]
    chain = Chain(image, track, Spectrum.of_image(image, CORES))
    aspects = [float(a) for a in chain.sub_apertures.aspects_rad]
    chain.run(aspects[:4])  # compiled code is loaded
    chain.carver.grid()
    chain = Chain(image, track, chain.sub_apertures.spectrum)
    literal = Literal(image, chain.sub_apertures)
    # Every round takes aspects from all round the circle; together they are the circle.
    portions = [aspects[i::ROUNDS] for i in range(ROUNDS)]
    shapes = transforms(chain, aspects)
    best = [min(t, key=t.__getitem__) for t in (fastest(shapes[0][0], 0), fastest(shapes[0][1], 1))]
    made = threading.local()

    def transform(index: int) -> None:
        if not hasattr(made, "plans"):
            made.plans = [{}, {}]
        for kind, shape in enumerate(shapes[index]):
            if shape not in made.plans[kind]:
                made.plans[kind][shape] = libraries()[best[kind]][kind](shape)
            for _ in range(1 + kind):  # rows are transformed and transformed back
                made.plans[kind][shape]()

    fast, slow, floor, cpu = [], [], [], []
    with ThreadPoolExecutor(CORES) as pool:
        list(pool.map(transform, range(len(aspects))))  # plans of every size are made
        for i, portion in enumerate(portions):
            wall, busy = timed(lambda portion=portion: chain.run(portion))
            fast.append(wall / len(portion))
            cpu.append(busy / len(portion))
            slow.append(timed(lambda portion=portion: literal.view(portion[0]))[0])
            chosen = range(i, len(aspects), ROUNDS)
            floor.append(timed(lambda chosen=chosen: list(pool.map(transform, chosen)))[0] / len(portion))
    grid_s = timed(chain.carver.grid)[0]
    once_s = (grid_s + float(np.median(spectrum_s))) / len(aspects)
    views = [f + once_s for f in fast]
    full_fft_s = float(np.median(spectrum_s)) / len(aspects)
    return {
        "views": len(aspects),
        "fast_s": float(np.median(views)) * len(aspects),
        "fast_ms_a_view": 1e3 * float(np.median(views)),
        "fast_cpu_ms_a_view": 1e3 * float(np.median(cpu)),
        "grid_s": grid_s,
        "spectrum_s": float(np.median(spectrum_s)),
        "literal_s_a_view": float(np.median(slow)),
        "floor_ms_a_view": 1e3 * (float(np.median(floor)) + full_fft_s),
        "floor_libraries": best,
        "literal_ratio": float(np.median([s / f for s, f in zip(slow, views, strict=True)])),
        "floor_ratio": float(np.median([v / (f + full_fft_s) for v, f in zip(views, floor, strict=True)])),
        "stages_ms": stage_times(chain),
    }


def stage_times(chain: Chain, repeats: int = 15) -> dict[str, float]:
    """Return the median milliseconds of each stage of one view, one thread."""
    p, position = chain.p, TARGET.position_m
    view = chain.sub_apertures.view_of_aspect(0.3)
    shadow = enhance(view, position, p.shadow)
    levels = view_levels(shadow, p.likelihood)
    mask = segment_shadow(shadow, position, p.likelihood, levels, reach_m=0.55)
    carver = Carver(volume(), p.carving)
    stamps = iter(range(10**6))

    def fresh() -> Any:
        return replace(levels, _echoes={})

    stages: dict[str, Callable[[], object]] = {
        "cut and transform the wedge": lambda: chain.sub_apertures.baseband(0.3),
        "sub-aperture, whole": lambda: chain.sub_apertures.view_of_aspect(0.3),
        "enhancement": lambda: enhance(view, position, p.shadow),
        "levels": lambda: view_levels(shadow, p.likelihood),
        "likelihood": lambda: outside_likelihood(shadow, p.likelihood, fresh()),
        "segmentation": lambda: segment_shadow(shadow, position, p.likelihood, fresh(), reach_m=0.55),
        "carving": lambda: carver.integrate(replace(mask, info=replace(mask.info, stamp_ns=next(stamps)))),
    }
    return {name: 1e3 * float(np.median([timed(f)[0] for _ in range(repeats)])) for name, f in stages.items()}


def measure_carving(work: Path) -> Report:
    """Count voxel-views a second of the default method, with and without its second look."""
    run = read_run(simulated(work, "standard"))
    chain = Chain(run.coherent_image(), run.require_track())
    chain.run([float(a) for a in chain.sub_apertures.aspects_rad])
    masks, voxels = chain.masks, int(np.prod(volume().shape))
    rates, whole = [], []
    with ThreadPoolExecutor(CORES) as pool:
        for _ in range(5):
            carver = Carver(volume(), chain.p.carving, pool=pool)
            first = timed(lambda carver=carver: [carver.integrate(m) for m in masks])[0]
            second = timed(carver.grid)[0]
            rates.append(voxels * len(masks) / first)
            whole.append(voxels * len(masks) / (first + second))
    return {
        "voxels": voxels,
        "views": len(masks),
        "voxel_views_per_s": float(np.median(rates)),
        "with_second_look_per_s": float(np.median(whole)),
    }


IN_PROCESS = """
import sys, time
began = time.perf_counter()
from csas_shadow_ros.bags import read_run
from csas_shadow_ros.core.pipeline import run
bag = read_run(sys.argv[1])
result = run(bag.coherent_image(), bag.require_track())
print(time.perf_counter() - began, result.views_used, int(result.grid.occupied.sum()))
"""
GRAPH = """
import sys, time
began = time.perf_counter()
from csas_shadow_ros.graph.replay import replay
result = replay(sys.argv[1], progress=False)
print(time.perf_counter() - began, result.views_used, int(result.grid.occupied.sum()))
"""


def in_fresh_process(code: str, bag: Path) -> dict[str, float]:
    """Run code in a process of its own; return its seconds, its result and the peak memory of its tree.

    CPU time is that of all processes of the tree, which others' work on the machine hardly changes.
    """
    before = os.times()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(bag)], stdout=subprocess.PIPE, text=True, env=environment
    )
    peak = 0
    while process.poll() is None:
        peak = max(peak, sum(map(proportional_kib, descendants(process.pid))))
        time.sleep(1.0)
    out = process.communicate()[0]
    if process.returncode:
        raise RuntimeError(f"a benchmark's process ended with status {process.returncode}; expected 0")
    seconds, views, voxels = map(float, out.split()[-3:])
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return {"s": seconds, "cpu_s": cpu_s, "views": views, "voxels": voxels, "peak_gib": peak / 2**20}


def descendants(pid: int) -> list[int]:
    """Return a process and all that it started."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except OSError:
                continue
            children.setdefault(parent, []).append(int(entry.name))
    found = [pid]
    for each in found:
        found += children.get(each, [])
    return found


def proportional_kib(pid: int) -> int:
    """Return a process' memory; what several share is shared out among them."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)


def measure_graph(work: Path) -> Report:
    """Time the node graph in turns with the pipeline in one process, both from nothing."""
    bag = simulated(work, "standard")
    pairs = [(in_fresh_process(GRAPH, bag), in_fresh_process(IN_PROCESS, bag)) for _ in range(GRAPH_ROUNDS)]
    return {
        "graph_s": float(np.median([g["s"] for g, _ in pairs])),
        "in_process_s": float(np.median([p["s"] for _, p in pairs])),
        "ratio": float(np.median([g["s"] / p["s"] for g, p in pairs])),
        "graph_cpu_s": float(np.median([g["cpu_s"] for g, _ in pairs])),
        "in_process_cpu_s": float(np.median([p["cpu_s"] for _, p in pairs])),
        "load": list(os.getloadavg()),
        "same_voxels": all(g["voxels"] == p["voxels"] for g, p in pairs),
        "graph_peak_gib": max(g["peak_gib"] for g, _ in pairs),
        "in_process_peak_gib": max(p["peak_gib"] for _, p in pairs),
    }


def measure_samdis(work: Path) -> Report:
    """Run the largest profile whole, in one process and through the node graph."""
    bag = simulated(work, "samdis")
    return {"in_process": in_fresh_process(IN_PROCESS, bag), "graph": in_fresh_process(GRAPH, bag)}


def measure_streaming(work: Path) -> Report:
    """Take the figures of ``benchmarks/streaming.py``, whose exit status says whether they are met."""
    out = work / "streaming.json"
    subprocess.run([sys.executable, str(HERE / "streaming.py"), "--json", str(out)], check=False)
    results = json.loads(out.read_text(encoding="utf-8"))["results"]
    kept_up = [r["rate"] for r in results if r["rate"] >= FAST_RATE and r["met"]]
    return {"p95_s": results[0]["p95_s"], "keeps_up_at": max(kept_up, default=0), "runs": results}


def measure_growth(work: Path) -> Report:
    """Time the chain against views, voxels and pixels."""
    run = read_run(simulated(work, "standard"))
    image, track = run.coherent_image(), run.require_track()
    spectrum = Spectrum.of_image(image, CORES)
    aspects = [float(a) for a in SubApertures(image, track, spectrum=spectrum).aspects_rad]

    def views(n: int) -> None:
        chain = Chain(image, track, spectrum)
        chain.run(aspects[:: len(aspects) // n])
        chain.carver.grid()

    views(36)
    chain = Chain(image, track, spectrum)
    chain.run(aspects[::10])

    def voxels(times: float) -> None:
        carver = Carver(volume(times), chain.p.carving)
        for mask in chain.masks:
            carver.integrate(mask)
        carver.grid()

    def pixels(side: int) -> None:
        grid = GroundGrid.centred(side, side, image.grid.spacing_m)
        rng = np.random.default_rng(side)
        noise = rng.standard_normal((side, side, 2), dtype=np.float32).view(np.complex64)[..., 0]
        scene = CoherentImage(noise, grid, image.acoustics)
        p = SubApertureParameters(aperture_deg=12.0)

        def work() -> None:
            sub_apertures = SubApertures(scene, track, p)
            for aspect in (0.3, 1.1, 2.0, 4.0):
                shadow = enhance(sub_apertures.view_of_aspect(aspect), TARGET.position_m)
                levels = view_levels(shadow)
                outside_likelihood(shadow, levels=levels)
                segment_shadow(shadow, TARGET.position_m, levels=levels)

        work()
        times.append(float(np.median([timed(work)[1] for _ in range(5)])))

    out: Report = {}
    for name, sizes, work_of in (
        ("views", [45, 90, 180, 360], views),
        ("voxels", [0.5, 1.0, 2.0, 4.0, 8.0], voxels),
    ):
        # CPU time: others' work on the machine hardly changes it.
        rounds = [[timed(lambda n=n, f=work_of: f(n))[1] for n in sizes] for _ in range(3)]  # type: ignore[misc]
        counts = sizes if name == "views" else [float(np.prod(volume(n).shape)) for n in sizes]
        out[name] = {"n": counts, "cpu_s": np.median(rounds, axis=0).tolist()}
    times: list[float] = []
    sides = [1024, 1448, 2048, 2896, 4096]
    for side in sides:
        pixels(side)
    out["pixels"] = {"n": [s * s for s in sides], "cpu_s": times}
    for name, values in out.items():
        n, t = np.log(values["n"]), np.log(values["cpu_s"])
        values["exponent"] = float(np.polyfit(n, t, 1)[0])
        bound = n if name != "pixels" else n + np.log(n)
        values["bound_exponent"] = float(np.polyfit(n, bound, 1)[0])
    draw_growth(out)
    return out


def draw_growth(growth: Report) -> None:
    """Plot time against size with the bound's shape through the last point."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, values) in zip(figure.subplots(1, 3), growth.items(), strict=True):
        n, t = np.array(values["n"], float), np.array(values["cpu_s"])
        shape = n * np.log(n) if name == "pixels" else n
        law = "n log n" if name == "pixels" else "n"
        axes.loglog(n, t, "o-", label=f"measured, n^{values['exponent']:.2f}")
        axes.loglog(n, shape * t[-1] / shape[-1], "--", color="0.5", label=f"∝ {law}")
        axes.set_xlabel(name)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("CPU time [s]")
        axes.legend()
        axes.grid(which="both", alpha=0.3)
    FIGURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(FIGURE, dpi=110)


#: How far a fitted exponent may lie over that of the bound's own shape.
EXPONENT_SLACK = 0.1


def lines(report: Report) -> list[tuple[str, str, str, str]]:
    """Return the table: measure, measured, bound, met; '-' where it was not measured."""
    out: list[tuple[str, str, str, str]] = []

    def add(name: str, measured: str, bound: str, met: bool | None) -> None:
        out.append((name, measured, bound, "-" if met is None else "yes" if met else "NO"))

    if c := report.get("chain"):
        r, f = c["literal_ratio"], c["floor_ratio"]
        add(
            "360 views to a 1 M voxel grid, against the literal reference", f"{r:.0f} x", ">= 150 x", r >= 150
        )
        add("the same against its FFTs alone", f"{f:.1f} x", "<= 2.5 x", f <= 2.5)
    if c := report.get("carving"):
        r = c["voxel_views_per_s"] / 1e6
        add("carving alone, million voxel-views a second", f"{r:.0f}", ">= 400", r >= 400)
        r = c["with_second_look_per_s"] / 1e6
        add("carving with the second look, the same", f"{r:.0f}", "-", None)
    if c := report.get("graph"):
        r = c["ratio"]
        add("node graph against the pipeline in one process", f"{r:.2f} x", "<= 1.5 x", r <= 1.5)
    if c := report.get("samdis"):
        for kind, values in c.items():
            share, peak = values["s"] / SAMDIS_CIRCLE_S, values["peak_gib"]
            measured = f"1/{1 / share:.1f}, {peak:.1f} GiB"
            name = f"samdis whole, {kind.replace('_', ' ')}, of the circle's {SAMDIS_CIRCLE_S:.0f} s"
            add(name, measured, "<= 1/6, <= 4 GiB", share <= 1 / 6 and peak <= 4)
    c = report.get("streaming") or {}
    if c:
        met = c["p95_s"] <= 0.5 and c["keeps_up_at"] >= 8
        keeps = f"{c['keeps_up_at']:g} x" if c["keeps_up_at"] else "not at 8 x"
        measured = f"p95 {c['p95_s']:.2f} s, {keeps}"
        add("streaming: sector to grid; keeps up at", measured, "<= 0.5 s, >= 8 x", met)
    else:
        add("streaming: sector to grid; keeps up at", "-", "<= 0.5 s, >= 8 x", None)
    for name, values in (report.get("growth") or {}).items():
        e, bound = values["exponent"], values["bound_exponent"]
        law = "n log n" if name == "pixels" else "n"
        add(f"growth with {name}", f"n^{e:.2f}", f"<= {law} (n^{bound:.2f})", e <= bound + EXPONENT_SLACK)
    return out


def table(report: Report) -> str:
    """Return the table as text."""
    rows = [("measure", "measured", "bound", "met"), *lines(report)]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


PARTS: dict[str, Callable[[Path], Report]] = {
    "fft": measure_fft,
    "chain": measure_chain,
    "carving": measure_carving,
    "graph": measure_graph,
    "samdis": measure_samdis,
    "streaming": measure_streaming,
    "growth": measure_growth,
}


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to run")
    parser.add_argument("--work", type=Path, help="folder for simulated bags; a temporary one otherwise")
    parser.add_argument("--out", type=Path, default=OUT, help="where the numbers go (JSON)")
    arguments = parser.parse_args()
    report: Report = {}
    if arguments.out.exists():
        report = json.loads(arguments.out.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory(prefix="csas_bench_") as scratch:
        work = arguments.work or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        for part in arguments.only:
            print(f"{part} ...", flush=True)
            found = PARTS[part](work)
            if found:
                report[part] = found
    report["machine"] = {
        "processor": processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }
    report["table"] = [
        dict(zip(("measure", "measured", "bound", "met"), row, strict=True)) for row in lines(report)
    ]
    arguments.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(table(report))
    return 0


def processor() -> str:
    """Return the processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor()


if __name__ == "__main__":
    sys.exit(main())
