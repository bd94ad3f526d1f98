r"""Simulate a circular SAS run: a complex image, its track, and the truth.

The image is made in its spectrum, I(x, y) = Σ S(K) exp(+jK·(x, y)) over the image's own lattice of
wavenumbers. Energy seen from aspect θ lies on the ray K û(θ), in the annulus of the band, so the
annulus is cut into wedges ("blocks", 0.5° wide): every lattice wavenumber belongs to exactly one, and
that block's sonar position decides what it sees:

    S(K) = exp(jφ(K)) [ F{ M_b r }(K) + ρ^½ Σ_n a_n exp(-jK·p_n,b) ] + noise,      K in wedge b

- r: the seabed, one complex white reflectivity, the same for every aspect. Were it drawn anew for each
  block, shadow edges would be no sharper than a block's own resolution.
- M_b: lit fraction of the seabed as the block's sonar casts shadows on it (times a slow level, if asked for).
- a_n, p_n,b: echoes of the scatterers that the sonar sees, imaged with layover at
  (x, y) + z tan ψ_b û(θ_b). In the wedge that is the phase K û·(x, y) + K tan ψ z.
- φ: residual phase error. Noise: white over the annulus; its level over the seabed's is the contrast.

F{M r} is needed in a narrow wedge only, so only the box of r's spectrum round the wedge, wider by the mask's
bandwidth π/edge, is transformed to a small baseband picture, masked there, and transformed back. What the
product folds over falls into that margin, not into the wedge. Echoes go into the box by a non-uniform FFT.

A sign σ = -1 is the same scene with all phases of the other sign: the conjugate image.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ducc0
import numpy as np
import scipy.fft
import trimesh
from numpy.typing import NDArray

from ..core.errors import ParameterError, check_range
from ..core.geometry import SCENE_FRAME, TWO_PI, Acoustics, CoherentImage, Track
from ..core.shape.solid import apart
from ..progress import ProgressOption, progress_bar
from .profiles import Faults, Profile, get_profile
from .scene import SceneModel
from .seabed import Seabed, SeabedModel
from .targets import Scene, make_scene

FloatArray = NDArray[np.float64]

EPOCH_NS = 1_700_000_000_000_000_000
_NUFFT_EPSILON = 1e-5
_PHASE_ERROR_MODES = 18  # periods round the circle: about 10° between bends
_WOBBLE_MODES = 12


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated run shows.

    Parameters
    ----------
    name : str
        Target's name.
    target, decor : trimesh.Trimesh
        Target, and solids that are no part of it, in the scene frame; without faces where there is none.
    dims_m : (float, float, float)
        Length, width and height of the target before it was turned.
    position_m, heading_rad
        Where it stands.
    seed : int
        Seed of everything random.
    profile : Profile
        Lattice, circle and band.
    faults : Faults
        What is wrong with the run.
    acoustics : Acoustics
        True band and spectrum sign, whatever the image claims.
    sonar_m : ndarray, shape (n, 3)
        True sonar positions of the poses, whatever the track claims.
    """

    name: str
    target: trimesh.Trimesh
    decor: trimesh.Trimesh
    dims_m: tuple[float, float, float]
    position_m: tuple[float, float]
    heading_rad: float
    seed: int
    profile: Profile
    faults: Faults
    acoustics: Acoustics
    sonar_m: FloatArray

    def __repr__(self) -> str:
        size = " × ".join(f"{side:.3f}" for side in self.dims_m)
        x, y = self.position_m
        return (
            f"Truth: {self.name}, {size} m, heading {math.degrees(self.heading_rad):.1f}°,"
            f" at x {x:.3f}, y {y:.3f} m, seed {self.seed}"
        )

    def save(self, path: str | Path) -> tuple[Path, Path]:
        """Write ``<path>.truth.stl`` and ``<path>.truth.json``.

        Returns
        -------
        stl, json : Path
            What was written. An empty seabed writes an STL file without triangles. Bodies that touch are
            written some micrometres apart (`core.solid.apart`): STL has no other way to tell them apart.

        Raises
        ------
        GeometryError
            If the target is not closed: nothing can be measured against such a truth.
        """
        base = Path(path)
        base.parent.mkdir(parents=True, exist_ok=True)
        stl = base.with_name(base.name + ".truth.stl")
        record = base.with_name(base.name + ".truth.json")
        stl.write_bytes(_stl(self.target))
        volume = float(self.target.volume) if len(self.target.faces) else 0.0
        values = {
            "name": self.name,
            "mesh": stl.name,
            "frame": "csas_scene",
            "length_m": self.dims_m[0],
            "width_m": self.dims_m[1],
            "height_m": self.dims_m[2],
            "volume_m3": volume,
            "position_m": list(self.position_m),
            "heading_rad": self.heading_rad,
            "seed": self.seed,
            "acoustics": dataclasses.asdict(self.acoustics),
            "profile": dataclasses.asdict(self.profile),
            "faults": dataclasses.asdict(self.faults),
        }
        record.write_text(json.dumps(values, indent=2) + "\n")
        return stl, record


def _stl(mesh: trimesh.Trimesh) -> bytes:
    if len(mesh.faces):
        return bytes(trimesh.exchange.stl.export_stl(apart(mesh)))
    return b"empty seabed".ljust(80, b" ") + (0).to_bytes(4, "little")


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A run and its truth.

    Parameters
    ----------
    image : CoherentImage
        Full-circle complex image (complex64); the seabed's amplitude is Rayleigh with mode 1.
    track : Track
        Sonar poses, as reported.
    truth : Truth
        What is really there.
    """

    image: CoherentImage
    track: Track
    truth: Truth

    def __repr__(self) -> str:
        parts = (repr(part).replace("\n", "\n  ") for part in (self.image, self.track, self.truth))
        return "\n  ".join(("SimulatedRun:", *parts))


@dataclass(frozen=True, eq=False)
class Wedges:
    """A partition of the annulus of an image's spectrum into aspect blocks.

    Block b holds the aspects [b Δ, (b + 1) Δ). Spectra are held as scipy.fft orders them: index (q, p) of
    (row, column), Kx = 2π p / (cols d), Ky = -2π q / (rows d) as rows grow southwards.

    Parameters
    ----------
    q, p : ndarray of int32, shape (n,)
        Signed lattice indices of all wavenumbers in the annulus, sorted by block.
    aspect_rad : ndarray of float32, shape (n,)
        Aspect of each, in [0, 2π).
    wavenumber : ndarray of float32, shape (n,)
        |K|, rad/m.
    starts : ndarray of int64, shape (blocks + 1,)
        Block b owns the entries starts[b] to starts[b + 1].
    """

    q: NDArray[np.int32]
    p: NDArray[np.int32]
    aspect_rad: NDArray[np.float32]
    wavenumber: NDArray[np.float32]
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, profile: Profile) -> Wedges:
        """Partition a profile's annulus."""
        rows, cols, d = profile.rows, profile.cols, profile.spacing_m
        k_low, _, k_high = profile.band_rad_m
        kx = TWO_PI * np.fft.fftfreq(cols, d)
        ky = -TWO_PI * np.fft.fftfreq(rows, d)
        q_all, p_all, k_all = [], [], []
        for first in range(0, rows, 256):  # in strips: a lattice of doubles of the largest profile is 330 MB
            k = np.hypot(kx[None, :], ky[first : first + 256, None])
            qi, pi = np.nonzero((k >= k_low) & (k < k_high))
            k_all.append(k[qi, pi].astype(np.float32))
            q_all.append((qi + first).astype(np.int32))
            p_all.append(pi.astype(np.int32))
        q, p, wavenumber = np.concatenate(q_all), np.concatenate(p_all), np.concatenate(k_all)
        aspect = np.mod(np.arctan2(ky[q], kx[p]), TWO_PI)
        blocks = round(360.0 / profile.block_deg)
        block = np.minimum((aspect * (blocks / TWO_PI)).astype(np.int32), blocks - 1)
        order = np.argsort(block, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(block, minlength=blocks))])
        q, p = q[order], p[order]
        q = np.where(q >= (rows + 1) // 2, q - rows, q).astype(np.int32)
        p = np.where(p >= (cols + 1) // 2, p - cols, p).astype(np.int32)
        return cls(q, p, aspect[order].astype(np.float32), wavenumber[order], starts.astype(np.int64))

    def __len__(self) -> int:
        return len(self.starts) - 1


def _smooth_round_circle(rng: np.random.Generator, modes: int) -> Callable[[Any], Any]:
    """Return a random periodic function of aspect with unit rms and zero mean."""
    weights = rng.standard_normal((modes, 2)) / np.sqrt(np.arange(1, modes + 1))[:, None]
    weights /= math.sqrt(float(np.sum(weights**2)) / 2.0)

    def function(aspect_rad: Any) -> Any:
        turns = np.multiply.outer(np.asarray(aspect_rad, dtype=np.float64), np.arange(1, modes + 1))
        return np.cos(turns) @ weights[:, 0] + np.sin(turns) @ weights[:, 1]

    return function


class _Orbit:
    """True sonar position at each aspect: the circle, and smooth departures in range and height.

    The circle is what the faults make of it.
    """

    def __init__(
        self,
        profile: Profile,
        faults: Faults,
        rng: np.random.Generator,
        *,
        clockwise: bool = False,
        start_aspect_deg: float = 0.0,
    ) -> None:
        self._profile, self._faults, self._wobble = profile, faults, faults.track_wobble_m
        self._start, self._sense = math.radians(start_aspect_deg), -1.0 if clockwise else 1.0
        # A track described by range and height as functions of its aspect misses nothing: a departure along
        # the circle only changes when the aspect is reached.
        self._range, self._height = (_smooth_round_circle(rng, _WOBBLE_MODES) for _ in range(2))

    def passed(self, aspect_rad: Any) -> Any:
        """Return which share of the circle was passed before each aspect, in [0, 1)."""
        return np.mod(self._sense * (np.asarray(aspect_rad, np.float64) - self._start), TWO_PI) / TWO_PI

    def _mean_range(self, aspect_rad: FloatArray) -> Any:
        f, r = self._faults, self._profile.radius_m
        turned = aspect_rad - math.radians(f.ellipse_deg)
        a, b = 1.0 + f.ellipse, 1.0 - f.ellipse
        out = r * (a * b / np.hypot(b * np.cos(turned), a * np.sin(turned)))
        out = out + f.spiral_m * (self.passed(aspect_rad) - 0.5)
        # A circle about another centre, as seen from the origin: |ρ û - offset| = its radius.
        x, y = f.track_offset_m
        along = x * np.cos(aspect_rad) + y * np.sin(aspect_rad)
        return along + np.sqrt(np.maximum(out**2 - (x**2 + y**2) + along**2, 0.0))

    def at(self, aspect_rad: FloatArray) -> FloatArray:
        """Return positions as the track reports them."""
        r = self._profile.radius_m + self._wobble * self._range(aspect_rad)
        z = self._profile.height_m + self._wobble * self._height(aspect_rad)
        if self._faults.leaves_circle:
            r = r - self._profile.radius_m + self._mean_range(aspect_rad)
        if np.min(z) <= 0.0 or np.min(r) <= 0.0:
            raise ParameterError(
                f"track_wobble_m is {self._wobble:g} m; expected one that keeps the sonar above the seabed"
            )
        return np.stack([r * np.cos(aspect_rad), r * np.sin(aspect_rad), z], axis=-1)

    def over_seabed(self, reported: FloatArray) -> FloatArray:
        """Return where the sonar really was over the seabed, of positions as reported."""
        if self._faults.tilt_deg == 0.0:
            return reported
        towards = math.radians(self._faults.tilt_towards_deg)
        rise = math.tan(math.radians(self._faults.tilt_deg))
        rises = (reported[:, :2] @ np.array([math.cos(towards), math.sin(towards)])) * rise
        true = reported - np.column_stack([np.zeros((len(rises), 2)), rises])
        if np.min(true[:, 2]) <= 0.0:
            raise ParameterError(
                f"tilt_deg is {self._faults.tilt_deg:g}; expected one that keeps the sonar above the seabed"
            )
        return np.asarray(true)


def _in_arcs(aspect_deg: Any, arcs: tuple[tuple[float, float], ...]) -> Any:
    inside = np.zeros(np.shape(aspect_deg), dtype=bool)
    for start, stop in arcs:
        inside |= np.mod(np.asarray(aspect_deg, dtype=np.float64) - start, 360.0) < stop - start
    return inside


def _phase_error(
    faults: Faults, rng: np.random.Generator, orbit: _Orbit, k_centre: float
) -> Callable[[Any], Any] | None:
    """Return the phase error at K(f_c) by aspect; it is in proportion to K."""
    smooth = _smooth_round_circle(rng, _PHASE_ERROR_MODES)
    displaced = faults.drift_m != (0.0, 0.0) or faults.radial_shift_m != 0.0
    if faults.phase_error_rad == 0.0 and faults.quadratic_phase_rad == 0.0 and not displaced:
        return None
    arc = math.radians(faults.quadratic_arc_deg)

    def phase(aspect_rad: Any) -> Any:
        within = np.mod(aspect_rad, arc) / arc - 0.5
        error = faults.phase_error_rad * smooth(aspect_rad) + faults.quadratic_phase_rad * (2.0 * within) ** 2
        if displaced:
            # What is imaged at p + δ instead of p has the phase -K·δ; δ along û counts alone.
            angle = np.asarray(aspect_rad, dtype=np.float64)
            along = faults.drift_m[0] * np.cos(angle) + faults.drift_m[1] * np.sin(angle)
            error = error - k_centre * (along * (orbit.passed(angle) - 0.5) + faults.radial_shift_m)
        return error

    return phase


def _white(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.complex64]:
    """Complex Gaussian noise of unit variance."""
    pairs = rng.standard_normal((*shape, 2), dtype=np.float32)
    pairs *= np.float32(math.sqrt(0.5))
    return pairs.view(np.complex64)[..., 0]


class _BlockMaker:
    """Makes the spectrum of one aspect block at a time; holds what all blocks share."""

    def __init__(
        self,
        profile: Profile,
        wedges: Wedges,
        model: SceneModel,
        seabed: NDArray[np.complex64],
        slope_db: float,
        arcs: tuple[tuple[float, float], ...],
        bed: SeabedModel | None = None,
    ) -> None:
        self.profile, self.wedges, self.model, self.seabed = profile, wedges, model, seabed
        self.bed = bed
        self.slope_db, self.arcs = slope_db, arcs
        d = profile.spacing_m
        extent = np.array([profile.rows * d, profile.cols * d])
        #: Bins that a mask's edges need on each side of a wedge.
        self.margin = np.ceil(extent / (2.0 * profile.edge_m)).astype(int)

    def make(self, block: int, sonar_m: FloatArray, aspect_rad: float) -> NDArray[np.complex64] | None:
        """Return S at the block's wavenumbers, seabed of unit variance, no noise; None if all are lost."""
        part = slice(int(self.wedges.starts[block]), int(self.wedges.starts[block + 1]))
        q, p = self.wedges.q[part], self.wedges.p[part]
        if len(q) == 0:
            return None
        lost = _in_arcs(np.degrees(self.wedges.aspect_rad[part].astype(np.float64)), self.arcs)
        if lost.all():
            return None
        spectrum = self._seabed_in_shadow(q, p, sonar_m)
        if not self.model.is_empty:
            spectrum = spectrum + self._echoes(q, p, sonar_m, aspect_rad)
        spectrum[lost] = 0.0
        return spectrum

    def _box(self, k: NDArray[np.int32], margin: int, size: int) -> tuple[int, int]:
        """Return (first index, count) of the spectrum's box along one axis; the whole lattice at most."""
        low, high = int(k.min()) - margin, int(k.max()) + margin
        count = scipy.fft.next_fast_len(high - low + 1)
        return (low, count) if count < size else (int(k.min()) - (size - int(np.ptp(k))) // 2, size)

    def _seabed_in_shadow(
        self, q: NDArray[np.int32], p: NDArray[np.int32], sonar_m: FloatArray
    ) -> NDArray[np.complex64]:
        rows, cols = self.profile.rows, self.profile.cols
        q0, n_rows = self._box(q, int(self.margin[0]), rows)
        p0, n_cols = self._box(p, int(self.margin[1]), cols)
        lit, window = self.model.lit_fraction(sonar_m, self.profile.grid, n_rows, n_cols)
        if lit is None and self.slope_db == 0.0 and self.bed is None:
            return self.seabed[q % rows, p % cols]
        # White on the image's lattice, the seabed has a spectrum that repeats beyond it.
        box = self.seabed[np.ix_((q0 + np.arange(n_rows)) % rows, (p0 + np.arange(n_cols)) % cols)]
        picture = ducc0.fft.c2c(box, axes=(0, 1), forward=False, inorm=2, nthreads=1)
        if self.bed is not None:
            picture *= self.bed.seen(sonar_m, lit, window, n_rows, n_cols)
        elif lit is not None:
            picture[window] *= lit
        if self.slope_db != 0.0:
            across = np.arange(n_cols) / n_cols - 0.5
            picture *= (10.0 ** (self.slope_db * across / 20.0)).astype(np.float32)
        masked = ducc0.fft.c2c(picture, axes=(0, 1), forward=True, nthreads=1, out=picture)
        return np.asarray(masked[q - q0, p - p0])

    def _echoes(
        self, q: NDArray[np.int32], p: NDArray[np.int32], sonar_m: FloatArray, aspect_rad: float
    ) -> NDArray[np.complex64]:
        rows, cols = self.profile.rows, self.profile.cols
        uv, amplitude = self.model.echoes(sonar_m, aspect_rad, self.profile.grid)
        if not len(uv):
            return np.zeros(len(q), dtype=np.complex64)
        angle = uv[:, ::-1] * np.array([TWO_PI / rows, TWO_PI / cols])  # (row, col)
        n_rows, n_cols = int(np.ptp(q)) + 1, int(np.ptp(p)) + 1
        middle = np.array([int(q.min()) + n_rows // 2, int(p.min()) + n_cols // 2])
        # One seabed wavenumber of unit variance is a seabed of 1/area power per square metre.
        area = rows * cols * self.profile.spacing_m**2
        strengths = (amplitude * np.exp(-1j * (angle @ middle)) / math.sqrt(area)).astype(np.complex64)
        out = np.empty((n_rows, n_cols), dtype=np.complex64)
        ducc0.nufft.nu2u(
            points=strengths,
            coord=np.mod(angle, TWO_PI).astype(np.float32),
            forward=True,
            epsilon=_NUFFT_EPSILON,
            nthreads=1,
            out=out,
        )
        return np.asarray(out[q - int(q.min()), p - int(p.min())])


def simulate(
    profile: str | Profile = "standard",
    target: str | Path | trimesh.Trimesh | Scene = "box",
    *,
    seed: int = 0,
    position_m: tuple[float, float] = (0.0, 0.0),
    heading_deg: float = 0.0,
    faults: Faults | None = None,
    spectrum_sign: int = 1,
    echo_db: float = 12.0,
    bed: Seabed | None = None,
    clockwise: bool = False,
    start_aspect_deg: float = 0.0,
    frame: str = SCENE_FRAME,
    workers: int | None = None,
    progress: ProgressOption = None,
) -> SimulatedRun:
    """Simulate a circular SAS run over a target on a rough seabed.

    Parameters
    ----------
    profile : str or Profile
        Name in `PROFILES` (``tiny``, ``small``, ``standard``, ``samdis``), or a profile.
    target : str, Path, trimesh.Trimesh or Scene
        Name in `TARGETS`, a closed mesh, a file of one (metres), or a scene as it stands.
    seed : int
        Of everything random. The same arguments give the same run bit for bit.
    position_m : (float, float)
        Scene x, y of the target.
    heading_deg : float
        Turn of the target, counter-clockwise.
    faults : Faults, optional
        What is wrong with the run; its noise too (`Faults.contrast_db`).
    spectrum_sign : int
        σ of the image: +1 or -1.
    echo_db : float
        Target's scattering strength at normal incidence over the seabed's.
    bed : Seabed, optional
        Levels and relief of the seabed; flat and of one level by default.
    clockwise : bool
        Which way the sonar goes round.
    start_aspect_deg : float
        Aspect of the first pose.
    frame : str
        Name of the scene's frame.
    workers : int, optional
        Threads; all processors by default. Does not change the result.
    progress : callable or bool, optional
        Called with (blocks done, blocks) from this thread. A bar in a terminal or a notebook by default;
        False: none.

    Returns
    -------
    SimulatedRun
        Image, track and truth.

    Raises
    ------
    ParameterError, GeometryError
        If an argument is out of range or a mesh is not usable.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> csas.simulate("tiny", "cylinder", heading_deg=30.0)
    SimulatedRun:
      CoherentImage: 512 × 512 pixels (complex64) of 0.005 m, x -1.28 to 1.28 m, y -1.28 to 1.28 m
        60 kHz, bandwidth 24 kHz, sound speed 1500 m/s, spectrum sign +1
      Track: 720 poses over 360.0° of the circle, radius 30.00 m, height 12.00 m, 0 gaps
      Truth: cylinder, ... m, heading 30.0°, at x 0.000, y 0.000 m, seed 0
    """
    profile = get_profile(profile)
    faults = faults if faults is not None else Faults()
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ParameterError(f"seed is {seed!r}; expected a whole number, 0 or more")
    check_range("echo_db", echo_db, -100.0, 100.0, "dB")
    true_acoustics = profile.acoustics(spectrum_sign)
    scene = _placed(target, position_m, heading_deg, seed)
    streams = [np.random.default_rng([seed, i]) for i in range(4)]
    orbit = _Orbit(profile, faults, streams[0], clockwise=clockwise, start_aspect_deg=start_aspect_deg)
    phase = _phase_error(faults, streams[1], orbit, profile.band_rad_m[1])
    maker = _block_maker(profile, scene, faults, bed, streams[2], seed=seed, echo_db=echo_db)
    threads = workers or os.cpu_count() or 1
    spectrum = _spectrum(maker, orbit, faults, phase, streams[3], threads, progress)
    pixels = scipy.fft.ifft2(spectrum, norm="forward", overwrite_x=True, workers=threads)
    if spectrum_sign == -1:
        np.conjugate(pixels, out=pixels)
    stamps, positions = _poses(profile, orbit, faults, clockwise, start_aspect_deg)
    reported = positions * np.array([1.0, 1.0, 1.0 + faults.height_error])
    made = np.ascontiguousarray(pixels)
    image = CoherentImage(
        made, profile.grid, _claimed(profile, faults, spectrum_sign), int(stamps[-1]), frame=frame
    )
    truth = Truth(
        name=scene.name,
        target=scene.target,
        decor=scene.decor,
        dims_m=scene.dims_m,
        position_m=scene.position_m,
        heading_rad=scene.heading_rad,
        seed=int(seed),
        profile=profile,
        faults=faults,
        acoustics=true_acoustics,
        sonar_m=orbit.over_seabed(positions),
    )
    return SimulatedRun(image, Track(stamps, reported, frame=frame), truth)


def _placed(
    target: str | Path | trimesh.Trimesh | Scene,
    position_m: tuple[float, float],
    heading_deg: float,
    seed: int,
) -> Scene:
    """Return the scene of a target put somewhere; a scene stands as it is."""
    if not isinstance(target, Scene):
        return make_scene(target, position_m, heading_deg, seed)
    if tuple(position_m) == (0.0, 0.0) and heading_deg == 0.0:
        return target
    raise ParameterError(
        f"position_m is {position_m} and heading_deg {heading_deg:g}; expected neither with a ready scene"
    )


def _block_maker(
    profile: Profile,
    scene: Scene,
    faults: Faults,
    bed: Seabed | None,
    rng: np.random.Generator,
    *,
    seed: int,
    echo_db: float,
) -> _BlockMaker:
    """Return what makes the spectrum of a scene on its seabed, the reflectivity drawn from `rng`."""
    k_low, k_centre, k_high = profile.band_rad_m
    model = SceneModel(
        scene,
        seed=seed,
        echo_db=echo_db,
        scatterer_spacing_m=math.pi / (k_high - k_low),
        cable_db=15.0,
        # The cell of a 12° sub-aperture, the width that cables are looked for with.
        cell_m=(TWO_PI / (k_high - k_low), TWO_PI / (k_centre * math.radians(12.0))),
    )
    wedges = Wedges.of(profile)
    seabed = _white(rng, (profile.rows, profile.cols))
    bed_model = None if bed is None or bed.is_plain else SeabedModel(bed, profile.grid)
    return _BlockMaker(
        profile, wedges, model, seabed, faults.seabed_slope_db, faults.missing_arcs_deg, bed_model
    )


def _spectrum(
    maker: _BlockMaker,
    orbit: _Orbit,
    faults: Faults,
    phase: Callable[[Any], Any] | None,
    rng: np.random.Generator,
    threads: int,
    progress: ProgressOption,
) -> NDArray[np.complex64]:
    """Return the image's spectrum: each block as its sonar sees it, with phase error and noise."""
    profile, wedges = maker.profile, maker.wedges
    # |I| is Rayleigh with mode 1 where E|I|² = 2; noise and seabed share that so that seabed with noise
    # over noise alone is the contrast.
    n = len(wedges.q)
    noise_share = 10.0 ** (-faults.contrast_db / 10.0)
    seabed_scale = np.float32(math.sqrt(2.0 / n * (1.0 - noise_share)))
    noise = _white(rng, (n,))
    noise *= np.float32(math.sqrt(2.0 / n * noise_share))

    blocks, k_centre = len(wedges), profile.band_rad_m[1]
    aspects = (np.arange(blocks) + 0.5) * (TWO_PI / blocks)
    sonar = orbit.over_seabed(orbit.at(aspects.astype(np.float64)))
    spectrum = np.zeros((profile.rows, profile.cols), dtype=np.complex64)

    def work(block: int) -> None:
        made = maker.make(block, sonar[block], float(aspects[block]))
        if made is None:
            return
        part = slice(int(wedges.starts[block]), int(wedges.starts[block + 1]))
        if phase is not None:
            error = phase(wedges.aspect_rad[part]) * (wedges.wavenumber[part] / k_centre)
            made = made * np.exp(1j * error).astype(np.complex64)
        kept = ~_in_arcs(np.degrees(wedges.aspect_rad[part].astype(np.float64)), faults.missing_arcs_deg)
        made = made * seabed_scale + noise[part] * kept
        spectrum[wedges.q[part], wedges.p[part]] = made  # negative indices count from the end

    with progress_bar(progress, "blocks") as bar, ThreadPoolExecutor(max_workers=threads) as pool:
        for done, _ in enumerate(pool.map(work, range(blocks)), start=1):
            bar(done, blocks)
    return spectrum


def _claimed(profile: Profile, faults: Faults, spectrum_sign: int) -> Acoustics:
    """Return the band and sign that the image states, true or not."""
    return Acoustics(
        profile.centre_frequency_hz,
        profile.bandwidth_hz,
        profile.sound_speed_mps * (1.0 + faults.sound_speed_error),
        -spectrum_sign if faults.wrong_sign else spectrum_sign,
    )


def _poses(
    profile: Profile, orbit: _Orbit, faults: Faults, clockwise: bool, start_aspect_deg: float
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return stamps (n,) and true positions (n, 3) of the poses, in the order in which they were passed."""
    count = round(360.0 / profile.pose_step_deg)
    step = 360.0 / count
    aspect_deg = start_aspect_deg + np.arange(count) * (-step if clockwise else step)
    seconds = np.arange(count) * math.radians(step) * profile.radius_m / profile.speed_mps
    stamps = EPOCH_NS + np.rint(seconds * 1e9).astype(np.int64)
    # A pose on the edge of a missing arc still closes the covered one, whichever edge it is.
    keep = ~_in_arcs(aspect_deg - 1e-9, faults.missing_arcs_deg) | ~_in_arcs(
        aspect_deg + 1e-9, faults.missing_arcs_deg
    )
    return stamps[keep], orbit.at(np.radians(aspect_deg[keep]))
