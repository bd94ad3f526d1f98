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
# # The method step by step
#
# One run goes through the method here, a step a cell. The run is a small simulated one, so that each cell takes a second or two. To take the
# demonstration instead, write `run = csas.read_run("bags/demo")`.

# %%
import math

import matplotlib.pyplot as plt
import numpy as np

import csas_shadow_ros as csas
from csas_shadow_ros.core.pipeline import ProcessedView

run = csas.simulate("tiny", "box", seed=5, heading_deg=20.0, progress=False)
run.image

# %% [markdown]
# ## The image of the full circle
#
# All aspects together: the box's faces are bright, its shadow is gone.


# %%
def show(axes, amplitude, title):
    """Show an amplitude in dB over its median."""
    with np.errstate(divide="ignore", invalid="ignore"):
        db = 20 * np.log10(np.abs(amplitude) / np.nanmedian(np.abs(amplitude)))
    axes.imshow(db, cmap="gray", vmin=-20, vmax=20)
    axes.set(title=title, xticks=[], yticks=[])


figure, axes = plt.subplots(figsize=(4, 4))
show(axes, run.image.pixels, "full circle")

# %% [markdown]
# ## Sub-apertures: look from one side
#
# A wedge of the spectrum is a view from one side. The sonar is above the picture, shadows fall downwards.

# %%
views = csas.SubApertures(run.image, run.track)
aspects = [math.radians(a) for a in (20.0, 65.0, 110.0)]
sub_apertures = [views.view_of_aspect(a) for a in aspects]
figure, row = plt.subplots(1, 3, figsize=(10, 3.6))
for axes, view in zip(row, sub_apertures, strict=True):
    show(axes, view.pixels, f"from {math.degrees(view.info.aspect_rad):.0f}°")

# %% [markdown]
# ## Find the target
#
# Nobody says where it is. `reconstruct` searches the scene, and then takes all views through the steps that follow.

# %%
p = csas.parameters(step_deg=10)
result = csas.reconstruct(run, p, progress=False)
target = result.target
target.position_m, target.size_m

# %% [markdown]
# ## Enhancement, likelihood, silhouette
#
# `ProcessedView` is the paper: a property for each step, made when you first ask for it.

# %%
processed = ProcessedView(target, p, sub_aperture=sub_apertures[1])
figure, row = plt.subplots(1, 4, figsize=(13, 3.6))
show(row[0], processed.sub_aperture.pixels, "sub-aperture")
show(row[1], processed.shadow.pixels, "shadow enhanced")
row[2].imshow(processed.likelihood.pixels, cmap="viridis", vmin=0, vmax=1)
row[2].set(title="likelihood outside", xticks=[], yticks=[])
row[3].imshow(processed.mask.pixels, cmap="gray")
row[3].set(title="silhouette", xticks=[], yticks=[]);

# %% [markdown]
# The view is also a camera: $\mathbf{P}$ takes a point of space to the pixel where its shadow falls. The shadow of a point 0.4 m over the target's middle:

# %%
camera = processed.shadow.info.camera
x, y = target.position_m
camera.project([[x, y, 0.0], [x, y, 0.4]])  # columns and rows, in pixels

# %% [markdown]
# ## Carving
#
# A voxel stays where no more than 3 % of the views contradict it. A slice through the middle shows the fraction that does.

# %%
grid = result.grid
figure, row = plt.subplots(1, 2, figsize=(9, 3.6))
shown = row[0].imshow(grid.likelihood[2], origin="lower", cmap="magma", vmax=0.5)
figure.colorbar(shown, ax=row[0], shrink=0.8)
row[0].set(title="contradicting views, third layer")
row[1].imshow(grid.occupied[2], origin="lower", cmap="gray_r")
row[1].set(title="what stays");

# %% [markdown]
# ## The result
#
# It shows itself as a table and a picture.

# %%
result

# %%
print("found:", result.dimensions)
print("true: ", run.truth)
assert result.verdict == "object"
assert result.mesh.is_watertight
