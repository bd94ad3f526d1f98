"""Recover shadows and 3-D shape from circular synthetic aperture sonar imagery."""

__version__ = "0.1.0"
