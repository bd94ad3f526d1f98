"""Pictures of the ground as cloud-optimised GeoTIFF, on the scene's own chart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..archive.extras import need
from .crs import affine_of, wkt_of
from .source import MapSource, Raster


def write_geotiff(source: MapSource, folder: Path) -> list[str]:
    """Write each picture as ``NAME.tif``; return their names.

    GDAL's COG driver makes tiles and overviews; amplitudes and heights stay what they are (float32).
    """
    need("rasterio", "export to GeoTIFF", "maps")
    return [_write(raster, source, folder) for raster in source.rasters]


def _write(raster: Raster, source: MapSource, folder: Path) -> str:
    import rasterio
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp
    from rasterio.transform import Affine

    colour = raster.pixels.ndim == 3
    bands = np.moveaxis(raster.pixels, -1, 0) if colour else raster.pixels[None].astype(np.float32)
    profile: dict[str, Any] = {
        "driver": "COG",
        "width": raster.grid.cols,
        "height": raster.grid.rows,
        "count": len(bands),
        "dtype": bands.dtype.name,
        "crs": CRS.from_wkt(wkt_of(source.datum, source.frame)),
        "transform": Affine(*affine_of(raster.grid, source.datum)),
        "compress": "DEFLATE",
        "predictor": "STANDARD" if colour else "FLOATING_POINT",
    }
    if not colour:
        profile["nodata"] = float("nan")
    name = f"{raster.name}.tif"
    with rasterio.open(folder / name, "w", **profile) as file:
        file.write(bands)
        file.update_tags(TIFFTAG_IMAGEDESCRIPTION=raster.about, TIFFTAG_SOFTWARE="csas_shadow_ros")
        if colour:
            file.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        else:
            file.set_band_description(1, raster.name)
            if raster.unit:
                file.set_band_unit(1, raster.unit)
    return name
