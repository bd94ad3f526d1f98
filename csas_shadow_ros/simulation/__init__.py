"""Seeded simulations of circular SAS runs with their truth: scenes, runs, bags of them, and shadow hulls."""

from .profiles import PROFILES, Faults, Profile, get_profile
from .run import SimulatedRun, Truth, simulate
from .targets import TARGETS, make_scene

__all__ = [
    "PROFILES",
    "TARGETS",
    "Faults",
    "Profile",
    "SimulatedRun",
    "Truth",
    "get_profile",
    "make_scene",
    "simulate",
]
