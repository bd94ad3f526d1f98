"""From an image to what its views show: sub-apertures, enhancement, likelihood, silhouettes, composites."""
