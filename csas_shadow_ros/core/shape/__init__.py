"""The shape: what the carved voxels, their echoes and the shadows' edges say of it, and how sure that is."""
