#!/usr/bin/env python3
"""Reconstruct a real vehicle from the shadows in 232 measured radar views.

Shadow carving asks nothing of the sensor but an oblique view: any image with shadows and a known geometry
is a view as ``docs/conventions.md`` defines it. This example takes public X-band radar chips of a T-72
(MSTAR), writes them as a bag that starts at ``shadow/image``, and reconstructs the vehicle from that bag with
the package's default parameters, but for voxels of 0.1 m.

    python examples/t72_shadows.py /path/to/mstar_T72_17deg.npz --out results/t72

The data are not part of the package. The file is a numpy archive with ``images`` (n, rows, cols) uint8,
``azimuth_deg`` (n,), and the scalars ``depression_deg``, ``range_spacing_slant_m``, ``cross_spacing_m``,
``jpeg_gain``, ``jpeg_offset``. Instead of a path, CSAS_REAL_DATA may name the folder that holds it.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from real_data import data_file

from csas_shadow_ros.bags import read_run, write_run
from csas_shadow_ros.core.errors import CsasError, NoTargetError
from csas_shadow_ros.core.geometry import (
    Acoustics,
    ShadowCamera,
    View,
    ViewInfo,
    cross_range_axis,
    down_range_axis,
    unit_to_sonar,
)
from csas_shadow_ros.core.later_stages import run_views
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters
from csas_shadow_ros.core.pipeline import ProcessedView, Result
from csas_shadow_ros.core.shape.mesh import Dimensions, measure, mesh_from_grid
from csas_shadow_ros.core.shape.volume import VoxelGrid
from msg_adapters.messages import RosbagsMessages
from msg_adapters.pairs import view_to_msgs

FILE = "mstar_T72_17deg.npz"
#: Hull's length (without the gun), width and height to the turret's roof.
TRUE_M = (6.95, 3.59, 2.23)

# The radar is far away: its rays are parallel for all that this scene can tell.
RADAR_RANGE_M = 5000.0
# X band. Shadows do not depend on it; a view's camera_info has to say something.
BAND = Acoustics(9.6e9, 0.591e9, 299_792_458.0, 1)
# c / (2 f · resolution) of 0.3 m: the arc that a chip integrates over.
APERTURE_RAD = math.radians(3.0)
EPOCH_NS = 1_700_000_000_000_000_000


def load_views(path: Path) -> list[View]:
    """Read chips as views.

    The chips' rows grow towards the radar, so they are flipped up-down: the radar is above the picture then,
    and shadows fall downwards. Their azimuth is a compass angle, clockwise, hence θ = 180° - azimuth; with
    it the flipped chip is a rotated map, not a mirrored one.

    Returns
    -------
    list of View
        float32 amplitude, in the order of the file.
    """
    with np.load(path) as data:
        chips, azimuths = data["images"], data["azimuth_deg"]
        gain, offset = float(data["jpeg_gain"]), float(data["jpeg_offset"])
        grazing = math.radians(float(data["depression_deg"]))
        spacing = float(data["range_spacing_slant_m"]) / math.cos(grazing), float(data["cross_spacing_m"])
    rows, cols = chips.shape[1:]
    views = []
    for number, (chip, azimuth) in enumerate(zip(chips, azimuths, strict=True)):
        aspect = math.radians(180.0 - float(azimuth))
        to_pixel = np.eye(3)
        to_pixel[0, :2] = cross_range_axis(aspect) / spacing[1]
        to_pixel[1, :2] = down_range_axis(aspect) / spacing[0]
        # The target stands near pixel (64, 64) of the file's 128 × 128, whose rows are turned round here.
        to_pixel[:2, 2] = cols // 2, rows - 1 - rows // 2
        ground = RADAR_RANGE_M * unit_to_sonar(aspect)
        radar = np.array([ground[0], ground[1], RADAR_RANGE_M * math.tan(grazing)])
        camera = ShadowCamera.from_ground(to_pixel, radar, rows, cols)
        amplitude = np.maximum(chip[::-1].astype(np.float32) - offset, 0.0) / gain
        info = ViewInfo(
            EPOCH_NS + number * 10**9, camera, BAND, aspect, APERTURE_RAD, (0.0, 0.0), focus_range_m=0.0
        )
        views.append(View(info, np.ascontiguousarray(amplitude, dtype=np.float32)))
    return views


def write_bag(path: Path, views: list[View]) -> Path:
    """Write a bag that starts at ``shadow/image`` and ``shadow/camera_info``: no image, no track."""
    factory = RosbagsMessages()
    messages = []
    for view in views:
        image, info = view_to_msgs(factory, view, "shadow")
        messages += [("shadow/camera_info", info), ("shadow/image", image)]
    return write_run(path, None, None, overwrite=True, extra=messages)


def reconstruct(bag: Path, parameters: PipelineParameters) -> Result:
    """Reconstruct what a bag of shadow views shows."""

    def views() -> list[View]:
        run = read_run(bag)
        found = list(run.views("shadow"))
        if run.problems:
            raise CsasError(f"{bag}: {run.problems[0]}; expected a bag without faults")
        return found

    return run_views(views, "shadow", parameters)


def body_of(grid: VoxelGrid, share: float = 1.0 / 3.0) -> VoxelGrid:
    """Keep an object's body: open every height slice, so that rods, cables and a gun go.

    The rule knows no metres: what is thinner in plan than `share` of the object's own thickness (the largest
    circle that fits its plan) is not body.

    Parameters
    ----------
    grid : VoxelGrid
        Carved grid.
    share : float
        Diameter of the opening's disc over that of the largest circle.
    """
    plan = np.pad(grid.occupied.any(axis=0), 1).astype(np.uint8)
    thickness = 2.0 * float(cv2.distanceTransform(plan, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).max())
    size = max(1, round(share * thickness)) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    slices = [
        cv2.morphologyEx(np.pad(s, size).astype(np.uint8), cv2.MORPH_OPEN, disc)[size:-size, size:-size]
        for s in grid.occupied
    ]
    return replace(grid, occupied=np.stack(slices).astype(bool))


@dataclass(frozen=True)
class Shape:
    """An object's measures, and those of its body alone."""

    whole: Dimensions
    body: Dimensions

    @classmethod
    def of(cls, grid: VoxelGrid) -> Shape:
        """Measure a grid.

        Raises
        ------
        NoTargetError
            If it holds no object.
        """
        return cls(measure(mesh_from_grid(grid)), measure(mesh_from_grid(body_of(grid))))


def silhouette(mesh: trimesh.Trimesh, camera: ShadowCamera) -> NDArray[np.bool_]:
    """Draw where a mesh casts its shadow in a view: P · X of all its triangles, filled."""
    triangles = camera.project(np.asarray(mesh.triangles))
    drawn = np.zeros(camera.shape, np.uint8)
    shift = 4
    for triangle in np.round(triangles * (1 << shift)).astype(np.int32):
        cv2.fillConvexPoly(drawn, triangle, 1, lineType=cv2.LINE_8, shift=shift)
    return drawn.astype(bool)


def agreement(result: Result, views: list[View]) -> NDArray[np.float64]:
    """Compare the reconstruction's shadow with each view's.

    Returns
    -------
    ndarray, shape (n, 2)
        For each view with a segmented shadow, the share of it that lies inside the reprojected silhouette;
        and the share of the silhouette that lies on lit ground (not in shadow, not in the target's echo).
    """
    if result.target is None or result.mesh is None:
        raise NoTargetError("there is no reconstruction to compare with the views")
    rows = []
    for view in views:
        mask = ProcessedView(result.target, PipelineParameters(), shadow=view).require("mask").pixels
        if not (mask == 255).any():
            continue
        drawn = silhouette(result.mesh, view.info.camera)
        rows.append([drawn[mask == 255].mean(), (mask[drawn] == 0).mean()])
    return np.array(rows)


def along_hull(points: Any, body: Dimensions) -> NDArray[np.float64]:
    """Turn points so that the body's length lies along the first axis, its middle at the origin."""
    c, s = math.cos(body.heading_rad), math.sin(body.heading_rad)
    out = np.array(points, dtype=np.float64)
    out[..., :2] = (out[..., :2] - body.position_m) @ np.array([[c, s], [-s, c]]).T
    return out


def draw_surface(axes: Any, triangles: NDArray[np.float64], height_m: float, span_m: float) -> None:
    """Draw a surface in 3-D, lit from one side, coloured by height."""
    import matplotlib.pyplot as plt
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = np.clip(normals @ np.array([-0.45, -0.55, 0.7]), 0.0, 1.0)
    height = np.clip(triangles[:, :, 2].mean(axis=1) / height_m, 0, 1)
    colours = plt.get_cmap("viridis")(0.15 + 0.75 * height)
    colours[:, :3] *= (0.35 + 0.65 * light)[:, None]
    axes.add_collection3d(Poly3DCollection(triangles, facecolors=colours, edgecolors="none", shade=False))
    axes.set(xlim=(-span_m, span_m), ylim=(-span_m, span_m), zlim=(0, 2.8))
    axes.set(xlabel="along the hull (m)", ylabel="across (m)")
    axes.set_zlabel("height (m)")
    axes.set_box_aspect((2 * span_m, 2 * span_m, 2.8))
    axes.view_init(elev=28, azim=-58)


def draw_voxels(
    panel: Any,
    points: NDArray[np.float64],
    body: NDArray[np.bool_],
    true_m: tuple[float, float],
    measured_m: tuple[float, float],
    *,
    above: bool,
) -> None:
    """Draw voxels from above or from the side, those of the body apart, with its true and measured size."""
    import matplotlib.pyplot as plt

    for chosen, colour, label in ((~body, "tab:orange", "thin parts"), (body, "tab:blue", "body")):
        panel.plot(points[chosen, 0], points[chosen, 1], "s", ms=3, color=colour, label=label)
    for (w, h), colour, label in (
        (true_m, "k", f"true hull {true_m[0]} × {true_m[1]} m"),
        (measured_m, "r", f"measured body {measured_m[0]:.2f} × {measured_m[1]:.2f} m"),
    ):
        corner = (-w / 2, -h / 2 if above else 0.0)
        panel.add_patch(plt.Rectangle(corner, w, h, fill=False, ec=colour, ls="--", lw=1.5, label=label))
    panel.set_ylabel("across (m)" if above else "height (m)")
    panel.set_ylim((-3, 3) if above else (-0.2, 3.4))
    panel.legend(fontsize=7, loc="upper right", ncols=2)


def draw_shape(path: Path, result: Result, shape: Shape, title: str) -> None:
    """Draw the carved surface in 3-D, from above and from the side."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    if result.mesh is None or result.grid is None:
        raise NoTargetError("there is no surface to draw")
    d = shape.body
    triangles = along_hull(result.mesh.triangles, d)
    span = float(np.abs(triangles[..., :2]).max()) * 1.02
    figure = plt.figure(figsize=(14, 6.5), layout="constrained")
    panels = figure.add_gridspec(2, 2, width_ratios=(1.1, 1), height_ratios=(1.6, 1))
    axes = figure.add_subplot(panels[:, 0], projection="3d")
    draw_surface(axes, triangles, d.height_m, span)
    axes.set_title(title)

    volume = result.grid.volume
    zz, yy, xx = np.nonzero(result.grid.occupied)
    points = along_hull(np.column_stack([volume.x_m[xx], volume.y_m[yy], volume.z_m[zz]]), d)
    body = body_of(result.grid).occupied[zz, yy, xx]
    for row, (other, name, true, size) in enumerate(
        ((1, "from above", TRUE_M[1], d.width_m), (2, "from the side", TRUE_M[2], d.height_m))
    ):
        panel = figure.add_subplot(panels[row, 1])
        panel.set(aspect="equal", xlim=(-span, span), xlabel="along the hull (m)", title=name)
        draw_voxels(
            panel, points[:, [0, other]], body, (TRUE_M[0], true), (d.length_m, size), above=other == 1
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_views(path: Path, result: Result, views: list[View], aspects_deg: tuple[float, ...]) -> None:
    """Draw views with the outline of the reconstruction's own shadow, reprojected by each view's camera."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    if result.mesh is None:
        raise NoTargetError("there is no surface to reproject")
    columns = len(aspects_deg)
    figure, axes = plt.subplots(2, columns, figsize=(3.4 * columns, 7), layout="constrained")
    for column, aspect in enumerate(aspects_deg):
        view = min(
            views, key=lambda v: abs(math.remainder(v.info.aspect_rad - math.radians(aspect), 2 * math.pi))
        )
        outline = silhouette(result.mesh, view.info.camera)
        for row in range(2):
            panel = axes[row, column]
            panel.imshow(np.sqrt(view.pixels), cmap="gray", vmin=0, vmax=0.6)
            panel.set(xticks=[], yticks=[])
            if row:
                panel.contour(outline, [0.5], colors="tab:red", linewidths=1.2)
            else:
                panel.set_title(f"aspect {math.degrees(view.info.aspect_rad) % 360:.0f}°")
    axes[0, 0].set_ylabel("view")
    axes[1, 0].set_ylabel("view, shadow of the\nreconstruction outlined")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def describe(name: str, grid: VoxelGrid, shape: Shape) -> str:
    """Return the lines that are printed of one method's grid."""
    lines = [f"{name}: threshold {grid.threshold:.3f}, {int(grid.occupied.sum())} voxels"]
    for what, d in (("whole", shape.whole), ("body ", shape.body)):
        size = (d.length_m, d.width_m, d.height_m)
        errors = ", ".join(f"{100 * (m / t - 1):+.0f} %" for m, t in zip(size, TRUE_M, strict=True))
        lines.append(f"  {what} {size[0]:.2f} × {size[1]:.2f} × {size[2]:.2f} m ({errors} of the true hull)")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("data", nargs="?", help=f"{FILE}, or the folder that holds it")
    parser.add_argument("--out", type=Path, default=Path("results/t72"), help="where the bag and the mesh go")
    parser.add_argument("--figures", type=Path, help="where the figures go (default: as --out)")
    parser.add_argument("--method", help="carving method (default: the package's)")
    options = parser.parse_args(argv)
    try:
        views = load_views(data_file(FILE, options.data))
        bag = write_bag(options.out / "bag", views)
        carving = {"voxel_size_m": 0.1} | ({"method": options.method} if options.method else {})
        result = reconstruct(bag, PipelineParameters(carving=CarvingParameters.from_mapping(carving)))
        print(f"{len(views)} views written to {bag}, {result.views_used} used; {result.target}")
        if result.grid is None or result.mesh is None:
            raise NoTargetError("no object was found in the views; expected the vehicle")
        shape = Shape.of(result.grid)
        print(describe(result.grid.method, result.grid, shape))
        if result.other_grid is not None and result.other_grid.occupied.any():
            print(describe(result.other_grid.method, result.other_grid, Shape.of(result.other_grid)))
        inside, lit = np.median(agreement(result, views), axis=0)
        print(
            f"median over views: {inside:.0%} of the segmented shadow lies inside the reprojected outline,"
            f" {lit:.0%} of the outline's inside is lit ground"
        )
        result.mesh.export(options.out / "t72.stl")
        figures = options.figures or options.out
        d = shape.body
        title = f"{d.length_m:.2f} × {d.width_m:.2f} × {d.height_m:.2f} m without thin parts"
        draw_shape(figures / "t72_shape.png", result, shape, title)
        draw_views(figures / "t72_views.png", result, views, (0.0, 60.0, 135.0, 285.0))
    except CsasError as error:
        print(f"t72_shadows: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
