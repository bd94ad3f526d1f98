"""A run that comes arc by arc: sectors, their sum, and the views that are ready meanwhile."""
