#!/usr/bin/env python3
"""Sub-apertures and composites of a real 360° circular SAS image, measured in air.

The image is of a cork cut-out on a turntable (AirSAS): 10 to 30 kHz, sonar 0.85 m from the middle and 0.24 m
up, 360 pings. Its board is smooth, so that there is no lit ground and no shadow: it shows sub-apertures
(section 3.1), multi-look and colour-by-aspect images (section 2) on measured data, and what the package says
where there is nothing to carve.

    python examples/airsas.py /path/to/airsas_small_features_cutout_20k_mic1.npy --out results/airsas

The data are not part of the package: a ``.npy`` of complex64 (rows +y, columns +x, origin in the middle) and
a ``.json`` of the same name. Instead of a path, CSAS_REAL_DATA may name the folder that holds them.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_data import data_file

from csas_shadow_ros.bags import read_run, write_run
from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.geometry import Acoustics, CoherentImage, GroundGrid, Track
from csas_shadow_ros.core.imaging.composites import Composites, level_image
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters
from csas_shadow_ros.core.pipeline import Result, run

FILE = "airsas_small_features_cutout_20k_mic1.npy"
EPOCH_NS = 1_700_000_000_000_000_000
#: The scene is 0.6 m across.
VOXEL_M = 0.005


def load_run(path: Path) -> tuple[CoherentImage, Track]:
    """Read the image and make its track.

    The file's rows grow with +y; a ground-plane image is north up, so they are turned round. The processor's
    phases put the energy seen from aspect θ at -K û(θ): spectrum_sign -1.
    """
    pixels = np.load(path)
    facts = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    rows, cols = pixels.shape
    grid = GroundGrid.centred(rows, cols, float(facts["pixel_spacing_m"]))
    low, high = float(facts["f_lo_hz"]), float(facts["f_hi_hz"])
    acoustics = Acoustics((low + high) / 2.0, high - low, float(facts["c_mean"]), -1)
    # Transmitter and microphone hang one over the other; the middle between them is the two-way phase centre.
    height = (float(facts["z_tx"]) + float(facts["z_rx"])) / 2.0
    pings = int(facts["n_pings"])
    aspects = np.radians(90.0 - np.arange(pings) * float(facts["azimuth_step_deg"]))
    radius = float(facts["radius_m"])
    positions = np.column_stack([radius * np.cos(aspects), radius * np.sin(aspects), np.full(pings, height)])
    stamps = EPOCH_NS + np.arange(pings, dtype=np.int64) * 10**9
    image = CoherentImage(np.ascontiguousarray(pixels[::-1]), grid, acoustics, int(stamps[-1]))
    return image, Track(stamps, positions)


def energy_in_band(image: CoherentImage, track: Track) -> tuple[float, float, float]:
    """Return (K_low, K_high, share of the image's energy between them): K = 4π f cos ψ / c, rad/m."""
    spectrum = Spectrum.of_image(image)
    rows, cols = spectrum.values.shape
    ky = 2 * math.pi * np.fft.fftfreq(rows, image.grid.spacing_m)
    kx = 2 * math.pi * np.fft.fftfreq(cols, image.grid.spacing_m)
    k = np.hypot(kx[None, :], ky[:, None])
    power = np.square(np.abs(spectrum.values), dtype=np.float64)
    low, _, high = image.acoustics.ground_band(track.grazing_rad)
    return low, high, float(power[(k >= low) & (k <= high)].sum() / power.sum())


@dataclass(eq=False)
class Outcome:
    """What the example makes of the run: some views by aspect (deg), and the whole chain's result."""

    image: CoherentImage
    track: Track
    views: dict[float, NDArray[np.complex64]]
    extent_m: float
    composites: Composites
    result: Result


def process(bag: Path, shown_deg: tuple[float, ...] = ()) -> Outcome:
    """Run the whole chain on a bag (sub-apertures 12° wide, every degree), and keep some of the views."""
    recorded = read_run(bag)
    image, track = recorded.coherent_image(), recorded.require_track()
    result = run(image, track, PipelineParameters(carving=CarvingParameters(voxel_size_m=VOXEL_M)))
    if result.composites is None:
        raise CsasError(f"{bag} gave no view: {next(iter(result.rejected.values()), 'no reason given')}")
    sub_apertures = SubApertures(image, track)
    views = {d: sub_apertures.view_of_aspect(math.radians(d)).pixels for d in shown_deg}
    extent = sub_apertures.size * sub_apertures.spacing_m
    return Outcome(image, track, views, extent, result.composites, result)


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def draw_composites(path: Path, outcome: Outcome) -> None:
    """Draw the image's spectrum, the multi-look and the colour-by-aspect image."""
    plt = _pyplot()
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.8), layout="constrained")
    image, track = outcome.image, outcome.track
    nyquist = math.pi / image.grid.spacing_m
    # Rows of the picture grow southwards, those of its spectrum along -Ky: north is up in both.
    level = np.fft.fftshift(np.abs(np.fft.fft2(image.pixels)))
    axes[0].imshow(
        20 * np.log10(level / level.max()), cmap="magma", vmin=-50, vmax=0, extent=(-nyquist, nyquist) * 2
    )
    low, _, high = image.acoustics.ground_band(track.grazing_rad)
    for k in (low, high):
        axes[0].add_patch(plt.Circle((0, 0), k, fill=False, ec="w", ls="--", lw=1))
    axes[0].set(title=f"spectrum, band {low:.0f} to {high:.0f} rad/m", xlabel="Kx (rad/m)")
    axes[0].set_ylabel("Ky (rad/m)")
    extent = outcome.composites.grid.extent_m
    axes[1].imshow(level_image(outcome.composites.multilook(), 25.0), cmap="gray", extent=extent)
    axes[1].set(title="multi-look", xlabel="x (m)", ylabel="y (m)")
    axes[2].imshow(outcome.composites.color_by_aspect(), extent=extent)
    axes[2].set(title="colour by aspect", xlabel="x (m)")
    half = image.grid.extent_m[1]
    for panel in axes[1:]:
        panel.set(xlim=(-half, half), ylim=(-half, half))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_sub_apertures(path: Path, outcome: Outcome) -> None:
    """Draw views in their own frame: the sonar is above each picture."""
    plt = _pyplot()
    figure, axes = plt.subplots(1, len(outcome.views), figsize=(14, 3.9), layout="constrained")
    top = max(float(np.nanpercentile(np.abs(v), 99.9)) for v in outcome.views.values())
    half = outcome.extent_m / 2.0
    for panel, (degrees, pixels) in zip(axes, sorted(outcome.views.items()), strict=True):
        with np.errstate(divide="ignore"):
            db = 20 * np.log10(np.abs(pixels) / top)
        panel.imshow(db, cmap="gray", vmin=-35, vmax=0, extent=(-half, half, half, -half))
        panel.set(title=f"aspect {degrees:.0f}°", xlabel="cross-range (m)")
    axes[0].set_ylabel("down-range (m)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("data", nargs="?", help=f"{FILE}, or the folder that holds it")
    parser.add_argument("--out", type=Path, default=Path("results/airsas"), help="where the bag goes")
    parser.add_argument("--figures", type=Path, help="where the figures go (default: as --out)")
    options = parser.parse_args(argv)
    try:
        image, track = load_run(data_file(FILE, options.data))
        bag = write_run(options.out / "bag", image, track, overwrite=True)
        low, high, share = energy_in_band(image, track)
        print(f"{bag}: band {low:.0f} to {high:.0f} rad/m holds {share:.1%} of the energy")
        outcome = process(bag, (0.0, 72.0, 144.0, 216.0, 288.0))
        result = outcome.result
        print(f"{len(outcome.composites.stamps)} sub-apertures; {result.sign}")
        if result.sign is not None:
            stated, other = result.sign.stated_evidence, result.sign.other_evidence
            print(f"evidence of a body: {stated:.1e} m⁴ as stated, {other:.1e} m⁴ with the other sign")
        found = f"object of {result.dimensions}" if result.mesh is not None else "no object"
        refused = f"{len(result.rejected)} views without a shadow"
        print(f"carving: {found}; {refused}")
        figures = options.figures or options.out
        draw_composites(figures / "airsas_composites.png", outcome)
        draw_sub_apertures(figures / "airsas_sub_apertures.png", outcome)
    except CsasError as error:
        print(f"airsas: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
