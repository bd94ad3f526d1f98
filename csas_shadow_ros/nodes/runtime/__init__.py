"""Building blocks of nodes."""
