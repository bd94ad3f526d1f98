"""Draw what the README and the site show: ``python docs/make/figures.py [BAG]`` writes docs/figures.

A moving picture of the circle and of the shape that it leaves, and the figures of the explanation. All of it
is drawn of what the package computes, of a simulated frame unless a bag is given.
"""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image

import csas_shadow_ros as csas
from csas_shadow_ros.core.geometry import GroundGrid
from csas_shadow_ros.core.imaging.likelihood import l_out
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.pipeline import process
from csas_shadow_ros.core.reconstruction import Reconstruction
from csas_shadow_ros.core.search.decision import decide_by_image
from csas_shadow_ros.results.figures import decibels, north_up

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs" / "figures"
STEP_DEG = 3.0
#: Views between two pictures of the circle: a picture every 9°.
PER_FRAME = 3
FRAME_MS, LAST_MS = 120, 3000
BLUE, GREEN, RED = "#4f7cac", "#1fd655", "#b3261e"
mpl.rcParams.update({"font.size": 11.0, "figure.facecolor": "white"})


def figure(width: float, height: float) -> Figure:
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def draw_mesh(axes, mesh) -> None:
    if mesh is None or not len(mesh.faces):
        return
    light = np.clip(np.asarray(mesh.face_normals) @ [-0.35, -0.55, 0.76], 0.0, 1.0)
    colours = np.clip(np.array([0.36, 0.56, 0.78]) * (0.35 + 0.75 * light)[:, None], 0.0, 1.0)
    solid = Poly3DCollection(np.asarray(mesh.triangles), facecolors=colours, edgecolors=colours)
    axes.add_collection3d(solid)


def solid_axes(made: Figure, where, target, reach: float, top: float, turn_deg: float):
    axes = made.add_subplot(where, projection="3d")
    x, y = target.position_m
    axes.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach), zlim=(0.0, top))
    axes.set_box_aspect((2 * reach, 2 * reach, top), zoom=1.25)
    axes.view_init(elev=28, azim=turn_deg)
    axes.set_axis_off()
    return axes


def circle_frame(view, result, target, reach: float) -> Image.Image:
    """Draw one view in its circle, and the shape that the views so far leave."""
    made = figure(8.0, 3.9)
    flat = made.add_subplot(1, 2, 1)
    pixels, side = 320, 5.0 * reach
    grid = GroundGrid.centred(pixels, pixels, side / pixels, target.position_m)
    radius = 0.5 * side
    shown = flat.imshow(decibels(north_up(view, grid)), cmap="gray", vmin=-18, vmax=18, extent=grid.extent_m)
    shown.set_clip_path(Circle(target.position_m, radius, transform=flat.transData))
    flat.add_patch(Circle(target.position_m, 1.05 * radius, fill=False, ec="0.6", lw=3))
    aspect = view.info.aspect_rad
    x, y = target.position_m
    sonar = (x + 1.05 * radius * math.cos(aspect), y + 1.05 * radius * math.sin(aspect))
    flat.plot(*sonar, "o", c=GREEN, ms=13, mec="k")
    flat.set(xlim=(x - 1.14 * radius, x + 1.14 * radius), ylim=(y - 1.14 * radius, y + 1.14 * radius))
    flat.set_aspect("equal")
    flat.set_axis_off()
    flat.set_title(f"shadow from {math.degrees(aspect) % 360:.0f}°", fontsize=11)
    axes = solid_axes(made, 122, target, reach, 0.8, -60.0)
    draw_mesh(axes, result.mesh)
    done = f"{result.views_used} views"
    if result.final and result.dimensions is not None:
        d = result.dimensions
        done += f": {d.length_m:.2f} × {d.width_m:.2f} × {d.height_m:.2f} m"
    axes.set_title(done, fontsize=11)
    file = io.BytesIO()
    made.savefig(file, format="png", dpi=80)
    return Image.open(file).convert("RGB")


def draw_circle(run, p) -> None:
    """Write circle.gif and carving_steps.png."""
    spectrum = Spectrum.of_image(run.image)
    decision = decide_by_image(run.image, run.track, p, spectrum=spectrum)
    target = decision.target
    views = SubApertures(run.image, run.track, p.sub_aperture, spectrum=spectrum)
    reconstruction = Reconstruction(decision, p)
    reach = 0.5 * max(target.size_m[:2])
    frames, steps = [], []
    asked = (1, 10, 40, len(views.aspects_rad))
    for number, aspect in enumerate(views.aspects_rad, start=1):
        made = process(views.view_of_aspect(float(aspect)), "sub_aperture", decision, p)
        for body, view in enumerate(made):
            reconstruction.add(view, body, reconstruction.parts_of(body))
        last = number == len(views.aspects_rad)
        if number % PER_FRAME == 0 or number in asked or last:
            result = reconstruction.result(final=last)
            if number % PER_FRAME == 0 or last:
                frames.append(circle_frame(made[0].shadow, result, target, reach))
            if number in asked:
                steps.append((number, result.mesh))
    palette = frames[-1].quantize(128)
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    times = [FRAME_MS] * (len(flat) - 1) + [LAST_MS]
    options = {"save_all": True, "append_images": flat[1:], "duration": times, "loop": 0, "optimize": True}
    flat[0].save(FIGURES / "circle.gif", **options)
    made = figure(11.0, 3.0)
    for index, (number, mesh) in enumerate(steps, start=1):
        axes = solid_axes(made, 140 + index, target, reach, 0.8, -60.0)
        draw_mesh(axes, mesh)
        axes.set_title("one view" if number == 1 else f"{number} views", fontsize=11)
    made.savefig(FIGURES / "carving_steps.png", dpi=90)


def draw_geometry() -> None:
    """Write shadow_geometry.png: a ray over the target, its shadow's end and its echo's place."""
    sonar, height, far = np.array([-7.0, 3.2]), 0.9, 0.6
    tip = sonar[0] + (far - sonar[0]) * sonar[1] / (sonar[1] - height)
    grazing = math.atan2(sonar[1], -sonar[0])
    made = figure(9.0, 3.4)
    axes = made.add_subplot()
    axes.axhline(0.0, color="0.35", lw=2)
    axes.plot([far, tip], [0.0, 0.0], color="k", lw=7, solid_capstyle="butt")
    axes.plot([sonar[0], tip], [sonar[1], 0.0], color=RED, lw=1.4)
    axes.fill([-far, far, far, -far], [0, 0, height, height], color=BLUE)
    axes.plot(*sonar, "o", color=GREEN, ms=13, mec="k")
    layover = -far - height * math.tan(grazing)
    axes.plot([-far, layover], [height, 0.0], color="0.4", ls=":", lw=1.4)
    axes.plot(layover, 0.0, "o", color="0.4")
    for text, at, where in (
        ("sonar s", sonar, (12, 2)),
        ("X = (x, y, z)", (far, height), (8, 6)),
        ("p′", (tip, 0.0), (-4, -24)),
        ("echo of the near edge:\nlaid over, towards the sonar", (layover, 0.0), (-120, -36)),
        ("shadow, z / tan ψ long", ((far + tip) / 2, 0.0), (-84, -24)),
        ("ψ", (tip, 0.0), (-64, 5)),
    ):
        axes.annotate(text, at, xytext=where, textcoords="offset points")
    axes.set(xlim=(-7.6, tip + 1.2), ylim=(-1.0, 3.7), aspect="equal")
    axes.set_axis_off()
    made.savefig(FIGURES / "shadow_geometry.png", dpi=110)


def draw_likelihood() -> None:
    """Write likelihood.png: the two densities of an amplitude, and the likelihood that follows."""
    amplitude = np.linspace(0.0, 3.0, 301)
    made = figure(9.0, 3.2)
    left, right = made.subplots(1, 2)
    for contrast_db, style in ((12.0, "-"), (6.0, "--")):
        contrast = 10.0 ** (contrast_db / 20.0)
        for name, sigma, colour in (("seabed", 1.0, BLUE), ("shadow", 1.0 / contrast, "k")):
            density = amplitude / sigma**2 * np.exp(-0.5 * (amplitude / sigma) ** 2)
            left.plot(amplitude, density, style, color=colour, label=f"{name}, {contrast_db:g} dB")
        power = (amplitude**2).astype(np.float32)
        right.plot(amplitude, l_out(power, contrast), style, color=RED, label=f"{contrast_db:g} dB")
    left.set(xlabel=r"amplitude $i/\sigma_r$", title="density of an amplitude")
    right.set(xlabel=r"amplitude $i/\sigma_r$", ylim=(0, 1.02))
    right.set_title("likelihood of lying outside the shadow")
    left.legend(frameon=False)
    right.legend(frameon=False, title="contrast")
    made.savefig(FIGURES / "likelihood.png", dpi=100)


def main() -> None:
    draw_geometry()
    draw_likelihood()
    if len(sys.argv) > 1:
        run = csas.read_run(sys.argv[1])
    else:
        run = csas.simulate("small", "frame", seed=1, heading_deg=25.0)
    draw_circle(run, csas.parameters(step_deg=STEP_DEG, voxel_size_m=0.025))


if __name__ == "__main__":
    main()
