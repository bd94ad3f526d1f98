"""Parameters of every stage: one bounded, described dataclass each.

The same dataclasses drive the in-process pipeline, the ROS parameter descriptors, the YAML file and
the table of docs/parameters.md. Users meet degrees here (``_deg``); the code behind works in radians.

Why no pydantic or msgspec: they would take over the checks of a value, some 70 lines of this file.
Descriptors with units, the ROS YAML file, options and tables would still be made of each field's metadata
as now, and errors still be put into the words of the package. Importing pydantic 2 takes 0.2 s and
msgspec 0.07 s, where dataclasses take 0.02 s (two busy cores, best of 7: ``python -c "from pydantic
import BaseModel, Field"`` less ``python -c pass``), in each node that starts by itself, as all do under
``ros2 launch``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

from .equality import equal_where_nan
from .errors import ParameterError, check_divides_circle
from .methods import METHODS, Method, method_named

if TYPE_CHECKING:
    from .geometry.place import Datum

P = TypeVar("P", bound="Parameters")

#: Kinds of views, first to last.
Stage = Literal["sub_aperture", "shadow", "likelihood", "shadow_mask"]
#: What a run may start from.
StartFrom = Literal["auto", "image", "sub_aperture", "shadow", "likelihood", "shadow_mask"]

# Choices of parameters: type checkers and editors know them, and `get_args` gives them to the checks.
Taper = Literal["none", "tukey", "taylor"]
Enhancement = Literal["exact", "small_angle", "none"]
Background = Literal["local", "global"]
ShadowLevel = Literal["estimated", "contrast"]
TargetChoice = Literal["auto", "given"]


def bounded(
    default: Any,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    unit: str = "",
    length: int | None = None,
    optional: bool = False,
) -> Any:
    """Declare a dataclass field with its bounds, unit and one line of description.

    A float, int, bool, str or tuple of floats (`length` long, each inside the bounds). An optional one is a
    float that may be NaN: not given.
    """
    meta = {"doc": doc, "low": low, "high": high, "choices": choices, "unit": unit, "length": length}
    meta["optional"] = optional
    return dataclasses.field(default=default, metadata=meta)


def _check_number(name: str, value: Any, field: dataclasses.Field[Any]) -> float | int:
    meta = field.metadata
    unit = f" {meta['unit']}" if meta["unit"] else ""
    kind = int if isinstance(field.default, int) else float
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"{name} is {value!r}; expected a number{unit and ' in' + unit}")
    if kind is int and math.isfinite(value) and float(value) != int(value):
        raise ParameterError(f"{name} is {value!r}; expected a whole number")
    low, high = meta["low"], meta["high"]
    if meta["optional"] and math.isnan(value):
        return math.nan
    if not math.isfinite(value) or (low is not None and value < low) or (high is not None and value > high):
        raise ParameterError(f"{name} is {value}{unit}; expected a number in [{low:g}, {high:g}]{unit}")
    return kind(value)


@dataclass(frozen=True)
class Parameters:
    """Base of all parameter sets: checks every field against its bounds.

    Raises
    ------
    ParameterError
        Naming the parameter, its value and the bounds.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        equal_where_nan(cls)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, name, meta = getattr(self, field.name), field.name, field.metadata
            checked: Any
            if isinstance(field.default, bool):
                if not isinstance(value, bool):
                    raise ParameterError(f"{name} is {value!r}; expected true or false")
                checked = value
            elif isinstance(field.default, str):
                if not isinstance(value, str) or (meta["choices"] and value not in meta["choices"]):
                    expected = ", ".join(meta["choices"]) or "a text"
                    raise ParameterError(f"{name} is {value!r}; expected one of: {expected}")
                checked = value
            elif isinstance(field.default, tuple):
                try:
                    items = tuple(value)
                except TypeError:
                    raise ParameterError(f"{name} is {value!r}; expected {meta['length']} numbers") from None
                if len(items) != meta["length"]:
                    raise ParameterError(f"{name} is {list(items)}; expected {meta['length']} numbers")
                checked = tuple(float(_check_number(name, item, field)) for item in items)
            else:
                checked = _check_number(name, value, field)
            object.__setattr__(self, name, checked)

    def check(self) -> None:
        """Check that fields fit together; each field's own bounds were checked at construction.

        Raises
        ------
        ParameterError
            Naming the parameters that do not go together.
        """

    @classmethod
    def from_mapping(cls: type[P], values: Mapping[str, Any]) -> P:
        """Make a parameter set from a mapping, such as a report's; refuse unknown names.

        Raises
        ------
        ParameterError
            If a name is unknown, a value is out of range, or two do not go together.
        """
        known = [f.name for f in dataclasses.fields(cls)]
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ParameterError(f"unknown parameter {unknown[0]!r}; expected one of: {', '.join(known)}")
        optional = {f.name for f in dataclasses.fields(cls) if f.metadata["optional"]}
        # JSON knows no NaN: a report tells an optional number that was not given as null.
        made = cls(**{n: math.nan if v is None and n in optional else v for n, v in values.items()})
        made.check()
        return made


#: Bodies carved if nothing else is asked for, the target among them. Each further one takes about half
#: of the target's time.
MAX_OBJECTS = 4
#: More than this are refused: their views would not fit into memory.
MOST_OBJECTS = 64


@dataclass(frozen=True)
class SubApertureParameters(Parameters):
    """Sub-aperture generation (section 3.1)."""

    aperture_deg: float = bounded(
        12.0, "set the full width of a sub-aperture", low=0.5, high=90.0, unit="deg"
    )
    step_deg: float = bounded(
        1.0, "step the aspect between views by this; divides 360", low=0.1, high=90.0, unit="deg"
    )
    taper: Taper = bounded(
        "none", "weight the aperture with this window ('none' is the paper's)", choices=get_args(Taper)
    )
    oversampling: float = bounded(
        1.5,
        "sample views with this many pixels per resolution cell of the wedge's bandwidth",
        low=1.0,
        high=8.0,
    )
    spacing_m: float = bounded(
        0.0, "set the views' pixel; 0: derive it from the wedge's bandwidth", low=0.0, high=100.0, unit="m"
    )
    extent_m: float = bounded(
        0.0,
        "set the side of the square views; 0: show the whole image at every aspect",
        low=0.0,
        high=1e5,
        unit="m",
    )
    min_coverage: float = bounded(
        0.75, "make a view only if the track covers at least this fraction of its aperture", low=0.0, high=1.0
    )
    check_sign: bool = bounded(True, "refuse an image if its shadows contradict its spectrum sign")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_divides_circle("step_deg", self.step_deg)


@dataclass(frozen=True)
class ShadowParameters(Parameters):
    """Shadow enhancement, FFSE (section 3.2)."""

    enhancement: Enhancement = bounded(
        "exact",
        "choose the filter: exact, the paper's simplified one, or none",
        choices=get_args(Enhancement),
    )


@dataclass(frozen=True)
class LikelihoodParameters(Parameters):
    """Likelihood of a pixel being outside the shadow (section 4.2) and shadow segmentation."""

    background: Background = bounded(
        "local",
        "estimate the seabed level as a smooth surface (local) or one value per view (global)",
        choices=get_args(Background),
    )
    shadow_level: ShadowLevel = bounded(
        "estimated", "measure the shadow level, or derive it from the contrast", choices=get_args(ShadowLevel)
    )
    shadow_contrast_db: float = bounded(
        12.0, "start the estimate with this ratio of seabed to shadow level", low=1.0, high=60.0, unit="dB"
    )
    smoothing_m: float = bounded(
        0.0,
        "average over this width before the likelihood; 0: do not, as in the paper",
        low=0.0,
        high=10.0,
        unit="m",
    )
    echo_unknown: bool = bounded(True, "read a target's echo as unknown (NaN) instead of outside")
    echo_db: float = bounded(
        8.0,
        "call a pixel echo if its smoothed intensity exceeds the seabed by this",
        low=1.0,
        high=60.0,
        unit="dB",
    )


@dataclass(frozen=True)
class CarvingParameters(Parameters):
    """Space carving (section 4)."""

    method: Method = bounded(
        "consensus",
        "carve by silhouettes that few (consensus) or no views (hard) contradict, or by mean l_out (soft)",
        choices=tuple(METHODS),
    )
    voxel_size_m: float = bounded(0.02, "set the edge of a voxel", low=1e-4, high=1e3, unit="m")
    threshold: float = bounded(
        0.0,
        "call a voxel object if its mean l_out (silhouettes: contradicting share of views) is below this;"
        " 0: choose automatically",
        low=0.0,
        high=1.0,
    )
    min_views_fraction: float = bounded(
        0.5,
        "call a voxel unknown if fewer of the views see it (consensus: object only if it stands on some)",
        low=0.0,
        high=1.0,
    )

    @property
    def takes_masks(self) -> bool:
        """Whether the method carves with segmented silhouettes rather than likelihoods."""
        return method_named(self.method).takes_masks

    def other(self) -> CarvingParameters:
        """Return the same parameters for the other kind of method, with its automatic threshold."""
        return dataclasses.replace(self, method=method_named(self.method).other, threshold=0.0)


@dataclass(frozen=True)
class TargetParameters(Parameters):
    """Target position and size of the carved volume."""

    target: TargetChoice = bounded(
        "auto", "find the target (auto), or carve at position_m (given)", choices=get_args(TargetChoice)
    )
    position_m: tuple[float, ...] = bounded(
        (0.0, 0.0), "set x, y of a given target", low=-1e6, high=1e6, unit="m", length=2
    )
    size_m: tuple[float, ...] = bounded(
        (0.0, 0.0, 0.0),
        "set the x, y, z size of the carved volume; 0: choose automatically",
        low=0.0,
        high=1e5,
        unit="m",
        length=3,
    )


#: Stages whose views a run can start from, first to last.
VIEW_STAGES: tuple[Stage, ...] = get_args(Stage)
#: What a run can start from; auto takes the first that the bag holds.
START_FROM: tuple[StartFrom, ...] = get_args(StartFrom)


@dataclass(frozen=True)
class PlaceParameters(Parameters):
    """Place on earth: a datum, instead of topic origin."""

    origin_lat_deg: float = bounded(
        math.nan,
        "set the latitude of the scene's origin, WGS-84",
        low=-90.0,
        high=90.0,
        unit="deg",
        optional=True,
    )
    origin_lon_deg: float = bounded(
        math.nan, "set the longitude of the scene's origin", low=-180.0, high=360.0, unit="deg", optional=True
    )
    origin_heading_deg: float = bounded(
        math.nan,
        "set the true bearing of the scene's y axis, clockwise; none: north",
        low=-360.0,
        high=360.0,
        unit="deg",
        optional=True,
    )
    origin_sigma_m: float = bounded(
        math.nan,
        "state the standard deviation of that origin, along east and north",
        low=0.0,
        high=1e5,
        unit="m",
        optional=True,
    )

    def check(self) -> None:
        """Refuse a latitude without a longitude, or the reverse."""
        super().check()
        if math.isnan(self.origin_lat_deg) != math.isnan(self.origin_lon_deg):
            given, lacking = ("lat", "lon") if math.isnan(self.origin_lon_deg) else ("lon", "lat")
            raise ParameterError(f"origin_{given}_deg is given, origin_{lacking}_deg is not; expected both")

    @property
    def given(self) -> bool:
        """Whether they state the origin, which then overrides topic origin."""
        return not math.isnan(self.origin_lat_deg)

    def datum(self, said: Datum | None = None) -> Datum | None:
        """Return the datum of a run.

        Parameters
        ----------
        said : Datum, optional
            What topic origin says. Latitude and longitude that are given come before it; a heading that is
            given turns it.
        """
        from .geometry.place import Datum  # late: the command line knows parameters before it loads numpy

        self.check()
        if self.given:
            heading = 0.0 if math.isnan(self.origin_heading_deg) else self.origin_heading_deg
            variance = self.origin_sigma_m**2
            covariance = None if math.isnan(variance) else (variance, variance, 0.0)
            return Datum(self.origin_lat_deg, self.origin_lon_deg, heading, covariance_m2=covariance)
        if said is None or math.isnan(self.origin_heading_deg):
            return said
        return dataclasses.replace(said, heading_deg=self.origin_heading_deg)


STAGES: dict[str, type[Parameters]] = {
    "sub_aperture": SubApertureParameters,
    "shadow": ShadowParameters,
    "likelihood": LikelihoodParameters,
    "carving": CarvingParameters,
    "target": TargetParameters,
    "place": PlaceParameters,
}


@dataclass(frozen=True)
class PipelineParameters:
    """Parameters of the whole chain, one set per stage."""

    sub_aperture: SubApertureParameters = dataclasses.field(default_factory=SubApertureParameters)
    shadow: ShadowParameters = dataclasses.field(default_factory=ShadowParameters)
    likelihood: LikelihoodParameters = dataclasses.field(default_factory=LikelihoodParameters)
    carving: CarvingParameters = dataclasses.field(default_factory=CarvingParameters)
    target: TargetParameters = dataclasses.field(default_factory=TargetParameters)
    place: PlaceParameters = dataclasses.field(default_factory=PlaceParameters)
