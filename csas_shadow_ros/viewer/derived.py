"""What the viewer makes itself: reduced sub-apertures, the other method's grid, dimensions nobody published.

Apart from `source`, which shows first pictures: this module imports the chain and its kernels.
"""

from __future__ import annotations

import logging
import math
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CsasError
from ..core.geometry import CoherentImage, Track, View
from ..core.imaging.subaperture import SubApertures
from ..core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from ..core.pipeline import ProcessedView
from ..core.reconstruction import Reconstruction
from ..core.search.decision import Decision
from ..core.shape.volume import Target, Volume
from . import codes
from .store import Entry, ViewStore

log = logging.getLogger(__name__)
#: Width of the reduced sub-apertures of figure 5 (deg).
_REDUCED_DEG = 4.0


class Reduced:
    """Sub-apertures of 4°, made when they are looked at (figure 5a)."""

    def __init__(self, image: CoherentImage, track: Track, p: SubApertureParameters) -> None:
        self._image, self._track = image, track
        self._p = replace(p, aperture_deg=min(_REDUCED_DEG, p.aperture_deg), spacing_m=0.0)
        # Browsers keep what an address gave: another run, with the same stamps, is to have others.
        sample = np.ascontiguousarray(image.pixels[::16, ::16])
        self._revision = f"{zlib.crc32(sample.tobytes()):08x}_{self._p.aperture_deg:g}"

    def fill(self, store: ViewStore) -> None:
        """Add one to the store for each sub-aperture view, or shadow view, that is there."""
        made = SubApertures(self._image, self._track, self._p)
        for one in list((store.sets["sub_aperture"] or store.sets["shadow"]).values()):
            aspect = one.info.aspect_rad
            try:
                info = made.info(aspect)
            except CsasError as error:
                log.info("no reduced view at %.1f deg: %s", math.degrees(aspect), error)
                continue

            def load(aspect: float = aspect) -> NDArray[np.uint8]:
                return codes.amplitude_codes(made.view_of_aspect(aspect).pixels)

            # The stamp of the view that it is compared with, to the nanosecond.
            entry = Entry(replace(info, stamp_ns=one.info.stamp_ns), self._revision, load)
            store.put_view("reduced", entry)


class Shape:
    """The other method's grid, and dimensions where nobody has published them, as views come in."""

    def __init__(self, store: ViewStore, parameters: CarvingParameters) -> None:
        self._store = store
        self.parameters = parameters
        self._taken: set[tuple[str, int]] = set()
        self._volume: Volume | None = None
        self._made: Reconstruction | None = None

    @property
    def other_stream(self) -> str:
        """Which stream the other method takes."""
        return "shadow_mask" if self.parameters.other().takes_masks else "likelihood"

    def pending(self) -> list[tuple[str, Entry]]:
        """Return the likelihoods and masks in the store that have not been taken yet."""
        main = self._store.grids.get("main")
        if main is None:
            return []
        self._on(main.volume)
        with self._store.lock:
            return [
                (name, entry)
                for name in dict.fromkeys((self.other_stream, "shadow_mask"))
                for entry in self._store.sets[name].values()
                if (name, entry.info.stamp_ns) not in self._taken
            ]

    def _on(self, volume: Volume) -> Reconstruction:
        if self._made is None or self._volume != volume:
            x, y, _ = volume.centre_m
            carving = replace(self.parameters, voxel_size_m=volume.voxel_size_m)
            decision = Decision(Target((x, y), volume.size_m))
            self._made = Reconstruction(decision, PipelineParameters(carving=carving), compose=False)
            self._volume, self._taken = volume, set()
        return self._made

    def add(self, name: str, entry: Entry) -> None:
        """Take one likelihood or mask."""
        main = self._store.grids.get("main")
        if main is None:
            return
        made = self._on(main.volume)
        self._taken.add((name, entry.info.stamp_ns))
        pixels: NDArray[Any] = entry.load()
        if name == "likelihood":
            pixels = codes.likelihood_of(pixels)
        view = View(entry.info, pixels)
        try:
            one = ProcessedView(made.decision.target, made.parameters, **{name: view})
            made.add(one, parts=(name.removeprefix("shadow_"),))
        except CsasError as error:
            log.info("%s: %s", name, error)  # the node that made it, or the report, names it too

    def publish(self, *, measure: bool) -> None:
        """Give the store what there is now."""
        if self._made is None:
            return
        other = self._made.bodies[0].other
        if other is not None and other.stamps:
            self._store.put_grid("other", other.grid(), self.parameters.min_views_fraction)
        if measure and self._made.stamps:
            self._store.put_dimensions(self._made.result().dimensions)


__all__ = ["Reduced", "Shape"]
