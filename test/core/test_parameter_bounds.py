"""Every field of every stage's parameters: described, bounded, and refused by name and value."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest

from csas_shadow_ros.core.errors import CsasError, ParameterError, check_range
from csas_shadow_ros.core.parameters import (
    STAGES,
    LikelihoodParameters,
    Parameters,
    PipelineParameters,
    PlaceParameters,
    SubApertureParameters,
    TargetParameters,
    bounded,
)

FIELDS = [(cls, field) for cls in STAGES.values() for field in dataclasses.fields(cls)]
NUMBERS = [
    (c, f) for c, f in FIELDS if isinstance(f.default, int | float) and not isinstance(f.default, bool)
]
TUPLES = [(c, f) for c, f in FIELDS if isinstance(f.default, tuple)]
TEXTS = [(c, f) for c, f in FIELDS if isinstance(f.default, str)]
FLAGS = [(c, f) for c, f in FIELDS if isinstance(f.default, bool)]


def ids(pairs):
    return [f"{c.__name__}.{f.name}" for c, f in pairs]


def refused(cls, field, value):
    text = re.escape(str(list(value)) if isinstance(value, tuple) else str(value))
    with pytest.raises(ParameterError, match=rf"{field.name} is '?{text}"):
        cls(**{field.name: value})


def test_every_field_falls_under_one_of_the_kinds_that_are_tested_here():
    assert len(NUMBERS) + len(TUPLES) + len(TEXTS) + len(FLAGS) == len(FIELDS)
    assert min(map(len, (NUMBERS, TUPLES, TEXTS, FLAGS))) > 0


@pytest.mark.parametrize(("cls", "field"), FIELDS, ids=ids(FIELDS))
def test_every_field_is_described_and_its_default_is_inside_its_bounds(cls, field):
    assert field.metadata["doc"]
    # NaN, not given, is the very same object, and no number equals it.
    default = getattr(cls(), field.name)
    assert default is field.default or default == field.default
    assert cls.from_mapping({field.name: field.default}) == cls()
    if not isinstance(field.default, bool | str):
        assert field.metadata["low"] < field.metadata["high"]


@pytest.mark.parametrize(("cls", "field"), NUMBERS, ids=ids(NUMBERS))
def test_a_number_out_of_its_bounds_is_refused(cls, field):
    low, high = field.metadata["low"], field.metadata["high"]
    for value in (low, high):
        assert getattr(cls(**{field.name: value}), field.name) == value
    refused(cls, field, low - 1e-6)
    refused(cls, field, high * (1 + 1e-9) + 1e-9)
    for value in (math.nan, math.inf, -math.inf):
        if math.isnan(value) and field.metadata["optional"]:
            assert math.isnan(getattr(cls(**{field.name: value}), field.name))
        else:
            refused(cls, field, value)


@pytest.mark.parametrize("value", ["5", None, [1.0], True, 1j])
@pytest.mark.parametrize(("cls", "field"), NUMBERS, ids=ids(NUMBERS))
def test_what_is_no_number_is_refused(cls, field, value):
    with pytest.raises(ParameterError, match=rf"{field.name} is {re.escape(repr(value))}; expected a number"):
        cls(**{field.name: value})


@pytest.mark.parametrize(("cls", "field"), TUPLES, ids=ids(TUPLES))
def test_a_tuple_of_the_wrong_length_kind_or_range_is_refused(cls, field):
    n, low, high = (field.metadata[k] for k in ("length", "low", "high"))
    inside = (1.0,) * n
    assert getattr(cls(**{field.name: list(inside)}), field.name) == inside
    refused(cls, field, inside[1:])
    refused(cls, field, (*inside, 1.0))
    with pytest.raises(ParameterError, match=rf"{field.name} is 3.0; expected {n} numbers"):
        cls(**{field.name: 3.0})
    for value in (low - 1.0, high + 1.0, math.nan, math.inf, "a"):
        with pytest.raises(ParameterError, match=rf"{field.name} is .*expected"):
            cls(**{field.name: (*inside[1:], value)})


@pytest.mark.parametrize(("cls", "field"), TEXTS, ids=ids(TEXTS))
def test_a_text_is_one_of_its_choices(cls, field):
    for choice in field.metadata["choices"]:
        assert getattr(cls(**{field.name: choice}), field.name) == choice
    for value in ("nonsense", field.default.upper(), ""):
        with pytest.raises(
            ParameterError, match=rf"{field.name} is '{value}'; expected one of: .*{field.default}"
        ):
            cls(**{field.name: value})
    with pytest.raises(ParameterError, match=rf"{field.name} is 3; expected one of"):
        cls(**{field.name: 3})


@pytest.mark.parametrize(("cls", "field"), FLAGS, ids=ids(FLAGS))
def test_a_flag_is_true_or_false_and_nothing_like_it(cls, field):
    for value in (1, 0, "true", None):
        with pytest.raises(ParameterError, match=rf"{field.name} is {value!r}; expected true or false"):
            cls(**{field.name: value})


@dataclasses.dataclass(frozen=True)
class Whole(Parameters):
    count: int = bounded(3, "how many", low=1, high=9)


@pytest.mark.parametrize("value", [0, 10, 2.5, math.nan, math.inf, "3"])
def test_a_whole_number_is_held_to_its_bounds_too(value):
    with pytest.raises(ParameterError, match="count is"):
        Whole(count=value)
    assert Whole(count=4.0).count == 4


@pytest.mark.parametrize("step_deg", [7.0, 0.1745])
def test_a_step_that_does_not_divide_the_circle_is_refused_at_once(step_deg):
    with pytest.raises(ParameterError, match=rf"step_deg is {step_deg:g} deg; expected a divisor of 360 deg"):
        SubApertureParameters(step_deg=step_deg)


def test_an_unknown_name_is_refused_and_the_known_ones_are_told():
    with pytest.raises(
        ParameterError, match=r"unknown parameter 'apperture'; expected one of: aperture_deg, step"
    ):
        SubApertureParameters.from_mapping({"apperture": 3})


def test_the_refusal_tells_value_bounds_and_unit():
    with pytest.raises(
        ParameterError, match=r"aperture_deg is 100 deg; expected a number in \[0.5, 90\] deg"
    ):
        SubApertureParameters(aperture_deg=100)
    with pytest.raises(ParameterError, match=r"echo_db is -1 dB; expected a number in \[1, 60\] dB"):
        LikelihoodParameters(echo_db=-1)


def test_parameters_cannot_be_changed_behind_the_checks():
    with pytest.raises(dataclasses.FrozenInstanceError):
        SubApertureParameters().aperture_deg = 400.0


def test_the_pipeline_holds_one_set_a_stage():
    p = PipelineParameters()
    assert {f.name for f in dataclasses.fields(p)} == set(STAGES)
    for name, cls in STAGES.items():
        assert getattr(p, name) == cls()


def test_the_defaults_of_the_views_are_the_paper_s():
    assert (SubApertureParameters().aperture_deg, SubApertureParameters().step_deg) == (12.0, 1.0)
    assert SubApertureParameters().taper == "none"
    assert TargetParameters().target == "auto"


@pytest.mark.parametrize("value", [0.0, -1.0, 2.1, math.nan])
def test_check_range_refuses_what_is_outside_and_names_it(value):
    with pytest.raises(ParameterError, match=rf"a length is {value} m; expected \(0, 2\] m"):
        check_range("a length", value, 0, 2, "m", open_low=True)
    assert check_range("a length", 2.0, 0, 2, "m", open_low=True) == 2.0


@pytest.mark.parametrize("value", ["x", None, [1.0]])
def test_check_range_refuses_what_is_no_number_with_the_package_s_own_error(value):
    with pytest.raises(ParameterError, match="a length is"):
        check_range("a length", value, 0, 2, "m")


def test_every_error_has_one_root():
    from csas_shadow_ros.core import errors

    raised = [e for e in vars(errors).values() if isinstance(e, type) and issubclass(e, Exception)]
    assert len(raised) > 5
    assert all(issubclass(e, CsasError) for e in raised)


def test_what_a_report_tells_as_null_is_an_optional_number_that_was_not_given():
    read = PlaceParameters.from_mapping({"origin_lat_deg": None, "origin_lon_deg": None})
    assert math.isnan(read.origin_lat_deg)
    assert not read.given
    with pytest.raises(ParameterError, match="step_deg is None"):
        SubApertureParameters.from_mapping({"step_deg": None})
