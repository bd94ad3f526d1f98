"""Seeded simulations of circular SAS runs with their truth: scenes, runs, bags of them, and shadow hulls."""

from .bag import simulate_bag
from .hull import iou, shadow_hull, voxelise_truth
from .profiles import PROFILES, Faults, Profile, get_profile
from .run import SimulatedRun, Truth, simulate
from .seabed import Bump, Patch, Seabed
from .targets import TARGETS, Scene, load_mesh, make_scene

__all__ = [
    "PROFILES",
    "TARGETS",
    "Bump",
    "Faults",
    "Patch",
    "Profile",
    "Scene",
    "Seabed",
    "SimulatedRun",
    "Truth",
    "get_profile",
    "iou",
    "load_mesh",
    "make_scene",
    "shadow_hull",
    "simulate",
    "simulate_bag",
    "voxelise_truth",
]
