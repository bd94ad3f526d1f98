"""Results on charts: rasters, contacts and labelled arrays that other programs read."""

from .export import FORMATS, Exported, export_result

__all__ = ["FORMATS", "Exported", "export_result"]
