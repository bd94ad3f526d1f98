"""Runs from what other processors write: an image, navigation, and a page of geometry."""

from .run import import_run
from .settings import ImportSettingsError, Settings, read_settings

__all__ = ["ImportSettingsError", "Settings", "import_run", "read_settings"]
