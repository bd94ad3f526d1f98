"""Load the simulator's compiled kernels; scores against a truth use most of them, too."""

from __future__ import annotations

import numpy as np

from ..core.shape.volume import Volume
from .hull import shadow_hull, voxelise_truth
from .occlusion import plain_tracer
from .targets import box


def warm_simulation() -> None:
    """Call the kernels on a box in a few voxels."""
    mesh, volume = box(), Volume.around((0.0, 0.0), (0.6, 0.6, 0.3), 0.1)
    voxelise_truth(mesh, volume)
    shadow_hull(mesh, np.array([[20.0, 0.0, 6.0]]), volume, spacing_m=0.05)
    plain_tracer(np.asarray(mesh.triangles))(np.zeros((1, 3)), np.array([[0.6, 0.0, 0.8]]))
