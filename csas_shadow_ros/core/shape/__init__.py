"""The shape, from carved voxels, their echoes and the shadows' edges, and its uncertainty."""
