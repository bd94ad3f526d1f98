"""Both message worlds, and one sample of everything that travels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.sectors.sector import Sector
from msg_adapters import RclpyMessages, RosbagsMessages

ACOUSTICS = Acoustics(120e3, 40e3, 1500.0, -1)
STAMP_NS = 1_700_000_000_123_456_789
ASPECT_RAD = math.radians(100.0)


@pytest.fixture(params=["rclpy", "rosbags"])
def factory(request):
    """Each message world in turn."""
    if request.param == "rclpy":
        pytest.importorskip("rclpy")
        return RclpyMessages()
    return RosbagsMessages()


def speckle(rows, cols, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.standard_normal((rows, cols)) + 1j * rng.standard_normal((rows, cols))).astype(np.complex64)


@pytest.fixture
def coherent():
    grid = GroundGrid.centred(12, 17, 0.02, (1.5, -2.25))
    return CoherentImage(speckle(12, 17), grid, ACOUSTICS, STAMP_NS)


@pytest.fixture
def sector():
    grid = GroundGrid.centred(12, 17, 0.02)
    return Sector(speckle(12, 17, 1), grid, ACOUSTICS, STAMP_NS, 0.3, 0.1, (400.0, -120.0))


def view_info(rows=9, cols=14, aspect=ASPECT_RAD, focus=2.5):
    sonar = (75 * math.cos(aspect), 75 * math.sin(aspect), 18.0)
    ground = view_ground_to_pixel(aspect, 0.04, rows, cols, (0.3, -0.2))
    camera = ShadowCamera.from_ground(ground, sonar, rows, cols)
    return ViewInfo(STAMP_NS, camera, ACOUSTICS, aspect, math.radians(12), (-50.0, 900.0), focus)


@pytest.fixture
def views():
    """One view of each stage, each with pixels that know nothing."""
    rng = np.random.default_rng(2)
    complex_pixels = speckle(9, 14)
    complex_pixels[0, :3] = np.nan
    amplitude = rng.rayleigh(size=(9, 14)).astype(np.float32)
    amplitude[3, 4] = np.nan
    likelihood = rng.random((9, 14)).astype(np.float32)
    likelihood[2] = np.nan
    mask = (rng.random((9, 14)) < 0.3).astype(np.uint8) * 255
    unfocused = view_info(focus=math.nan)
    return {
        "sub_aperture": View(unfocused, complex_pixels),
        "shadow": View(view_info(), amplitude),
        "likelihood": View(view_info(), likelihood),
        "shadow_mask": View(view_info(), mask),
    }


@pytest.fixture
def track():
    aspects = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    ones = np.ones_like(aspects)
    positions = np.column_stack([75 * np.cos(aspects), 75 * np.sin(aspects), 18 * ones])
    return Track(STAMP_NS + np.arange(180) * 500_000_001, positions)
