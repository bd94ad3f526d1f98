"""The page of an archive: map, table, thumbnails; a click opens the run."""

from .server import ArchiveServer, view_archive

__all__ = ["ArchiveServer", "view_archive"]
