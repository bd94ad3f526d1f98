"""What may hold NaN is equal to its copy, in every Python and from every process."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pickle
import pkgutil
from typing import Any

import pytest

import csas_shadow_ros
import msg_adapters
from csas_shadow_ros.core.geometry.place import Place
from csas_shadow_ros.core.parameters import PlaceParameters


def dataclasses_with_nan() -> list[type[Any]]:
    """Find every public frozen dataclass with a field that is NaN where nothing is known."""
    found = {}
    modules = [
        module.name
        for package in (csas_shadow_ros, msg_adapters)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not module.name.endswith("__main__")
    ]
    for module_name in modules:
        for name, one in vars(importlib.import_module(module_name)).items():
            if not (isinstance(one, type) and dataclasses.is_dataclass(one)):
                continue
            defaults = [f.default for f in dataclasses.fields(one)]
            if any(isinstance(d, float) and math.isnan(d) for d in defaults):
                found[name] = one
    return list(found.values())


@pytest.mark.parametrize("kind", dataclasses_with_nan(), ids=lambda kind: kind.__name__)
def test_a_copy_from_another_process_is_equal_to_its_original(kind: type[Any]) -> None:
    one = object.__new__(kind)
    for field in dataclasses.fields(kind):
        value = None if field.default is dataclasses.MISSING else field.default
        object.__setattr__(one, field.name, value)

    assert pickle.loads(pickle.dumps(one)) == one


def test_hash_of_a_copy_is_that_of_its_original() -> None:
    place = PlaceParameters()

    assert len({place, pickle.loads(pickle.dumps(place))}) == 1


def test_a_number_is_not_equal_to_one_that_is_not_given() -> None:
    assert Place(48.0, -4.0, 10.0, 0.1) != Place(48.0, -4.0, 10.0)
    assert Place(48.0, -4.0, 10.0) != (48.0, -4.0, 10.0)
