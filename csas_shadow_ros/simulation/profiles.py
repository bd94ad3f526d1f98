"""Profiles and faults: what a simulated run looks like before anything is put on the seabed.

A profile fixes the image's lattice, the circle and the band. A lattice of spacing d holds the wavenumbers
below π/d; the image's energy ends at K(f_c + B/2) = 4π (f_c + B/2) cos ψ / c. A profile whose band
does not fit its lattice is refused: the far edge of the annulus would fold back into the other side.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from ..core.errors import ParameterError, check_divides_circle, check_range, check_type
from ..core.geometry import Acoustics, GroundGrid
from ..core.parameters import Parameters, bounded


@dataclass(frozen=True)
class Profile(Parameters):
    """Lattice, circle and band of a simulated run.

    Raises
    ------
    ParameterError
        If a field is out of bounds, or if the band does not fit the lattice.
    """

    name: str = bounded("standard", "name of the profile")
    rows: int = bounded(2048, "rows of the image", low=32, high=16384)
    cols: int = bounded(2048, "columns of the image", low=32, high=16384)
    spacing_m: float = bounded(0.0025, "pixel spacing of the image", low=1e-5, high=10.0, unit="m")
    centre_m: tuple[float, ...] = bounded(
        (0.0, 0.0), "scene x, y of the middle of the image", low=-1e3, high=1e3, unit="m", length=2
    )
    radius_m: float = bounded(75.0, "radius of the circle", low=0.1, high=1e6, unit="m")
    height_m: float = bounded(18.0, "height of the sonar over the seabed", low=0.01, high=1e6, unit="m")
    centre_frequency_hz: float = bounded(120e3, "centre frequency", low=1.0, high=1e12, unit="Hz")
    bandwidth_hz: float = bounded(40e3, "bandwidth", low=1.0, high=1e12, unit="Hz")
    sound_speed_mps: float = bounded(1500.0, "sound speed", low=1.0, high=3e8, unit="m/s")
    block_deg: float = bounded(
        0.5, "aspect block with one sonar position; divides 360", low=0.05, high=5.0, unit="deg"
    )
    edge_m: float = bounded(
        0.012, "how finely shadow edges are drawn in each block", low=1e-4, high=10.0, unit="m"
    )
    pose_step_deg: float = bounded(
        0.5, "aspect between poses of the track; divides 360", low=0.05, high=30.0, unit="deg"
    )
    speed_mps: float = bounded(1.5, "speed along the circle", low=0.01, high=1e5, unit="m/s")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("block_deg", "pose_step_deg"):
            check_divides_circle(name, getattr(self, name), off_deg=1e-6)
        _, _, k_max = self.band_rad_m
        if k_max > math.pi / self.spacing_m:
            raise ParameterError(
                f"profile {self.name!r}: the band ends at K = {k_max:.1f} rad/m; expected below π/spacing ="
                f" {math.pi / self.spacing_m:.1f} rad/m (spacing {self.spacing_m:g} m): it would alias"
            )

    def acoustics(self, spectrum_sign: int = 1) -> Acoustics:
        """Return the band as the processing chain's type."""
        return Acoustics(self.centre_frequency_hz, self.bandwidth_hz, self.sound_speed_mps, spectrum_sign)

    @property
    def grid(self) -> GroundGrid:
        """The image's lattice."""
        return GroundGrid.centred(self.rows, self.cols, self.spacing_m, (self.centre_m[0], self.centre_m[1]))

    @property
    def grazing_rad(self) -> float:
        """ψ = atan2(h, R)."""
        return math.atan2(self.height_m, self.radius_m)

    @property
    def band_rad_m(self) -> tuple[float, float, float]:
        """(K(f_c - B/2), K(f_c), K(f_c + B/2)), rad/m."""
        return self.acoustics().ground_band(self.grazing_rad)


PROFILES: dict[str, Profile] = {
    p.name: p
    for p in (
        Profile(
            name="tiny",
            rows=512,
            cols=512,
            spacing_m=0.005,
            radius_m=30.0,
            height_m=12.0,
            centre_frequency_hz=60e3,
            bandwidth_hz=24e3,
            block_deg=1.0,
            edge_m=0.02,
        ),
        Profile(name="small", rows=1792, cols=1792, spacing_m=0.0028, height_m=30.0),
        Profile(),
        Profile(
            name="samdis",
            rows=6400,
            cols=6400,
            spacing_m=0.00125,
            height_m=36.0,
            centre_frequency_hz=300e3,
            bandwidth_hz=60e3,
        ),
    )
}


def get_profile(profile: str | Profile, **overrides: Any) -> Profile:
    """Return a profile by name, with some fields replaced.

    Parameters
    ----------
    profile : str or Profile
        One of `PROFILES`, or a profile.
    **overrides
        Fields of `Profile`.

    Raises
    ------
    ParameterError
        If the name or a field is unknown, or a value is out of bounds.
    """
    check_type("profile", profile, (str, Profile), "a name or a Profile")
    if not isinstance(profile, Profile):
        if profile not in PROFILES:
            raise ParameterError(f"profile is {profile!r}; expected one of: {', '.join(PROFILES)}")
        profile = PROFILES[profile]
    return Profile.from_mapping({**dataclasses.asdict(profile), **overrides}) if overrides else profile


@dataclass(frozen=True)
class Faults:
    """What is wrong with a simulated run, besides its noise.

    Parameters
    ----------
    contrast_db : float
        Seabed over shadow level, 20 log10(σ_r/σ_s), set by white noise over the annulus.
    track_wobble_m : float
        Rms departure of the sonar from the circle, in ground range and in height each, smooth in aspect.
        The track reports it faithfully.
    height_error : float
        The track reports heights (1 + this) times the true ones.
    missing_arcs_deg : tuple of (start, stop)
        Arcs, counter-clockwise from start to stop, with no imagery and no poses.
    phase_error_rad : float
        Rms residual phase error at K(f_c), smooth over aspect (about 10°), proportional to K.
    quadratic_phase_rad : float
        Phase error at the edges of consecutive arcs of `quadratic_arc_deg`, parabolic inside each.
    quadratic_arc_deg : float
        Length of those arcs.
    wrong_sign : bool
        The image's metadata claims the opposite spectrum sign.
    sound_speed_error : float
        The image's metadata claims (1 + this) times the true sound speed.
    seabed_slope_db : float
        Seabed level rises by this much over the image, west to east.
    track_offset_m : (float, float)
        Centre (x, y) of the circle. The track reports it faithfully, as it does the next two.
    ellipse, ellipse_deg : float
        The track's semi-axes are (1 ± this) times the radius, the long one in this direction.
    spiral_m : float
        How much farther out the sonar is at the end of the circle than at its start.
    tilt_deg, tilt_towards_deg : float
        The seabed rises by this slope in this direction against the level that the track refers to: the
        sonar is lower over the seabed there than the track says. The scene lies in the seabed's plane.
    drift_m : (float, float)
        Position error (x, y) that grows evenly along the track, from minus to plus half of this, and is in
        the image, not in the track.
    radial_shift_m : float
        Every aspect is imaged so much too near to its sonar.

    Raises
    ------
    ParameterError
        If a value is out of bounds.
    """

    contrast_db: float = bounded(15.0, "seabed over shadow level", low=0.1, high=100.0, unit="dB")
    track_wobble_m: float = bounded(
        0.0, "rms departure from the circle, reported", low=0.0, high=1e5, unit="m"
    )
    height_error: float = bounded(0.0, "the track reports heights (1 + F) times true", low=-0.9, high=10.0)
    missing_arcs_deg: tuple[tuple[float, float], ...] = ()
    phase_error_rad: float = bounded(0.0, "rms residual phase error", low=0.0, high=100.0, unit="rad")
    quadratic_phase_rad: float = bounded(
        0.0, "parabolic phase error of each arc", low=-100.0, high=100.0, unit="rad"
    )
    quadratic_arc_deg: float = bounded(12.0, "length of those arcs", low=0.5, high=360.0, unit="deg")
    wrong_sign: bool = bounded(False, "the bag states the opposite spectrum sign")
    sound_speed_error: float = bounded(0.0, "the bag states (1 + F) times the true c", low=-0.5, high=1.0)
    seabed_slope_db: float = bounded(
        0.0, "seabed level rises so much west to east", low=-60.0, high=60.0, unit="dB"
    )
    track_offset_m: tuple[float, float] = bounded(
        (0.0, 0.0), "centre x, y of the circle, reported", low=-1e5, high=1e5, unit="m", length=2
    )
    ellipse: float = bounded(0.0, "semi-axes are (1 ± F) times the radius, reported", low=0.0, high=0.5)
    ellipse_deg: float = bounded(0.0, "direction of the long semi-axis", unit="deg")
    spiral_m: float = bounded(
        0.0, "growth of the radius over the circle, reported", low=-1e5, high=1e5, unit="m"
    )
    tilt_deg: float = bounded(
        0.0, "slope of the seabed against the track's level", low=0.0, high=30.0, unit="deg"
    )
    tilt_towards_deg: float = bounded(0.0, "direction in which it rises", unit="deg")
    drift_m: tuple[float, float] = bounded(
        (0.0, 0.0), "position error x, y that grows along the track", low=-1e5, high=1e5, unit="m", length=2
    )
    radial_shift_m: float = bounded(
        0.0, "every aspect is imaged so much too near", low=-1e3, high=1e3, unit="m"
    )

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, meta = getattr(self, field.name), field.metadata
            if meta.get("low") is not None:
                for number in value if meta["length"] else (value,):
                    check_range(field.name, number, meta["low"], meta["high"], meta["unit"])
        object.__setattr__(self, "missing_arcs_deg", _check_arcs(self.missing_arcs_deg))

    @property
    def leaves_circle(self) -> bool:
        """Whether the track is no circle about the scene's origin, wobble left out."""
        return self.track_offset_m != (0.0, 0.0) or self.ellipse != 0.0 or self.spiral_m != 0.0


def _check_arcs(arcs: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    checked = []
    for arc in arcs:
        try:
            start, stop = (float(a) for a in arc)
        except (TypeError, ValueError):
            raise ParameterError(f"missing arc is {arc!r}; expected (start, stop) in degrees") from None
        if not 0.0 < stop - start < 360.0:
            raise ParameterError(
                f"missing arc is ({start:g}, {stop:g}) deg; expected start < stop < start + 360"
            )
        checked.append((start, stop))
    return tuple(checked)
