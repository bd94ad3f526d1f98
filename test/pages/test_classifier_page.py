"""The mask stage that the page on classifiers shows: what it makes of a box is a box."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csas_shadow_ros.core import pipeline
from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.later_stages import run_views
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters

PAGE = Path(__file__).parents[2] / "docs" / "classifier.md"


def shown_stage() -> Callable[[Any, Any], Any]:
    """Return the page's `segment`, without the node that it is given to."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (code,) = [block for block in blocks if "def segment" in block]
    names: dict[str, Any] = {}
    exec(code[: code.index("rclpy.init()")], names)
    return names["segment"]


def test_the_mask_stage_that_the_page_shows_carves_a_box(tiny_box_bag):
    pytest.importorskip("rclpy")
    segment, run = shown_stage(), tiny_box_bag.run
    p = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=10.0))
    masks: list[View] = []

    def keep(view: pipeline.ProcessedView) -> None:
        shadow = view.require("shadow")
        masks.append(View(shadow.info, segment(shadow.pixels, shadow.info)))

    own = pipeline.run(run.image, run.track, p, on_view=keep)
    assert {int(v) for mask in masks for v in np.unique(mask.pixels)} == {0, 128, 255}
    result = run_views(lambda: iter(masks), "shadow_mask", p, decision=own.decision)
    assert result.verdict == "object"
    assert result.dimensions is not None
    # A cell and a quarter.
    assert result.dimensions.length_m == pytest.approx(0.8, abs=0.08)
    assert result.dimensions.width_m == pytest.approx(0.4, abs=0.08)
    assert result.dimensions.height_m == pytest.approx(0.4, abs=0.06)
