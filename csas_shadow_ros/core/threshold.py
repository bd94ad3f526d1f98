"""From mean likelihoods to the object's voxels."""
from __future__ import annotations
import numpy as np
def object_threshold(likelihood, method): return 0.2
def occupied_voxels(likelihood, threshold):
    with np.errstate(invalid="ignore"): return likelihood<threshold
