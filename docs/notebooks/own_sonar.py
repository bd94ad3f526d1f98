# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A sonar of your own
#
# What would your sonar see? Describe it, simulate a run, and find out which settings matter before you go to sea.

# %%
import matplotlib.pyplot as plt
import numpy as np

import csas_shadow_ros as csas
from csas_shadow_ros.simulation import get_profile

sonar = get_profile(
    "tiny",
    name="my_sonar",
    radius_m=40.0,
    height_m=14.0,
    centre_frequency_hz=50e3,
    bandwidth_hz=20e3,
)
low, centre, high = sonar.band_rad_m
print(f"grazing angle {np.degrees(sonar.grazing_rad):.1f}°, {low:.0f} to {high:.0f} rad/m on the ground")
across_m = 2 * np.pi / centre / np.radians(12.0)
print(f"resolution in range {2 * np.pi / (high - low):.3f} m, across {across_m:.3f} m in a view of 12°")

# %% [markdown]
# A band that does not fit the pixels is refused, with what fits them:

# %%
try:
    get_profile(sonar, centre_frequency_hz=120e3)
except csas.CsasError as error:
    print(error)

# %% [markdown]
# ## A clean run

# %%
made = csas.simulate(sonar, "tyre", seed=1, progress=False)
p = csas.parameters(step_deg=10, voxel_size_m=0.03)
result = csas.reconstruct(made, p, progress=False)
result

# %% [markdown]
# ## A worse sea
#
# The shadow is only 8 dB darker than the seabed, and the vehicle wobbles.

# %%
faults = csas.Faults(contrast_db=8.0, track_wobble_m=0.2)
rough = csas.simulate(sonar, "tyre", seed=1, faults=faults, progress=False)
worse = csas.reconstruct(rough, p, progress=False)
print(worse)

# %% [markdown]
# ## Too large for the image
#
# The image must hold the target and its whole shadow. A cylinder 1.8 m long on an image of 2.56 m does not fit. The result is undecided: it names the place, and says that the shadow leaves the image:

# %%
large = csas.simulate(sonar, "cylinder", seed=1, progress=False)
print(csas.reconstruct(large, p, progress=False))

# %% [markdown]
# ## Which method?
#
# `consensus` is the default. Each result also holds the grid that the other kind of carving leaves, here the paper's `soft`.

# %%
volumes = {grid.method: grid.occupied.sum() * grid.volume.voxel_size_m**3 for grid in (result.grid, result.other_grid)}
figure, axes = plt.subplots(figsize=(6, 3))
axes.bar(list(volumes), list(volumes.values()))
axes.axhline(made.truth.target.volume, color="k", ls="--", label="true")
axes.set(ylabel="volume (m³)")
axes.legend();

# %% [markdown]
# ## Your own arrays
#
# A processor's image and track take the place of `made`: [Bring your own images](../own_images.html).

# %%
image = csas.CoherentImage(made.image.pixels, made.image.grid, sonar.acoustics())
track = csas.Track(made.track.stamps_ns, made.track.positions_m)
mine = csas.reconstruct(csas.Run.of(image, track), p, progress=False)
assert mine.dimensions == result.dimensions
print(mine)
