"""A simulated run as other programs would have written it: images and navigation in their formats."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyproj
import rasterio
from rasterio.transform import Affine
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from csas_shadow_ros.bags import BagWriter
from csas_shadow_ros.bags.bag import typestore
from csas_shadow_ros.core.geometry import CoherentImage, Track

#: Where the scene is, for routes that know places: latitude, longitude, altitude of the seabed.
PLACE = 48.3829, -4.4953, 31.5
ORIGIN = {"latitude_deg": PLACE[0], "longitude_deg": PLACE[1], "altitude_m": PLACE[2]}
#: A chart round that place, with an offset as charts have them.
CHART = f"+proj=tmerc +lat_0={PLACE[0]} +lon_0={PLACE[1]} +x_0=500000 +y_0=200000 +datum=WGS84 +units=m"

#: From the scene, east north up, to longitude and latitude (degrees) and altitude.
_FROM_SCENE = (
    "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84"
    f" +lat_0={PLACE[0]} +lon_0={PLACE[1]} +h_0={PLACE[2]} +step +inv +proj=cart +ellps=WGS84"
    " +step +proj=unitconvert +xy_in=rad +xy_out=deg"
)

Page = dict[str, dict[str, Any]]
Route = Callable[[Any, Path], tuple[Path, Page]]


# -- images: each returns the file, and what the page of geometry has to say of it -------------------


def lattice(image: CoherentImage) -> dict[str, Any]:
    return {"spacing_m": image.grid.spacing_m, "centre_m": list(image.grid.centre_m)}


def npy(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    np.save(folder / "image.npy", image.pixels)
    return folder / "image.npy", {"image": lattice(image)}


def npy_south_up(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    np.save(folder / "image.npy", image.pixels[::-1])
    corner = [image.grid.x_min_m, image.grid.y_max_m]
    page = {"spacing_m": image.grid.spacing_m, "corner_m": corner, "rows": "north"}
    return folder / "image.npy", {"image": page}


def npz_by_x(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    """Write the array that is indexed [x, y], beside another one."""
    np.savez(folder / "image.npz", slc=image.pixels[::-1].T, weights=np.ones(3))
    return folder / "image.npz", {"image": {**lattice(image), "rows": "east"}}


def npz_of_parts(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    np.savez(folder / "image.npz", i=image.pixels.real, q=image.pixels.imag)
    return folder / "image.npz", {"image": {**lattice(image), "real": "i", "imag": "q"}}


def mat(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    savemat(folder / "image.mat", {"img": image.pixels, "x": image.grid.x_of_columns()})
    return folder / "image.mat", {"image": lattice(image)}


def mat_73(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    """Write what MATLAB's -v7.3 does: HDF5 after a header of 512 bytes, columns first, parts in pairs."""
    path = folder / "image.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        pairs = np.empty(image.pixels.T.shape, [("real", "<f4"), ("imag", "<f4")])
        pairs["real"], pairs["imag"] = image.pixels.T.real, image.pixels.T.imag
        file["img"] = pairs
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path, {"image": lattice(image)}


def hdf5(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    with h5py.File(folder / "image.h5", "w") as file:
        file["sas/slc"] = image.pixels
        file["sas/slc_low"] = image.pixels[::4, ::4]
        file["sas/nav"] = np.zeros((4, 3))
    return folder / "image.h5", {"image": {**lattice(image), "variable": "sas/slc"}}


def tiff(image: CoherentImage, folder: Path, crs: str | None = None, offset=(0.0, 0.0)) -> Path:
    left, _, _, top = image.grid.extent_m
    d = image.grid.spacing_m
    with rasterio.open(
        folder / "image.tif",
        "w",
        driver="GTiff",
        width=image.grid.cols,
        height=image.grid.rows,
        count=1,
        dtype="complex64",
        crs=crs,
        transform=Affine(d, 0.0, left + offset[0], 0.0, -d, top + offset[1]),
    ) as file:
        file.write(image.pixels.astype(np.complex64), 1)
    return folder / "image.tif"


def geotiff(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    return tiff(image, folder), {}


def geotiff_on_a_chart(image: CoherentImage, folder: Path) -> tuple[Path, Page]:
    return tiff(image, folder, CHART, (500_000.0, 200_000.0)), {"origin": ORIGIN}


_SICD = """<SICD xmlns="urn:SICD:1.4.0">
<CollectionInfo><CollectorName>x</CollectorName><CoreName>x</CoreName><RadarMode><ModeType>SPOTLIGHT</ModeType>
</RadarMode><Classification>UNCLASSIFIED</Classification></CollectionInfo>
<ImageData><PixelType>RE32F_IM32F</PixelType><NumRows>{rows}</NumRows><NumCols>{cols}</NumCols>
<FirstRow>10</FirstRow><FirstCol>20</FirstCol><FullImage><NumRows>9000</NumRows><NumCols>9000</NumCols>
</FullImage><SCPPixel><Row>{row}</Row><Col>{col}</Col></SCPPixel></ImageData>
<GeoData><EarthModel>WGS_84</EarthModel><SCP><ECF><X>{x}</X><Y>{y}</Y><Z>{z}</Z></ECF>
<LLH><Lat>{lat}</Lat><Lon>{lon}</Lon><HAE>{alt}</HAE></LLH></SCP><ImageCorners>
<ICP index="1:FRFC"><Lat>{lat}</Lat><Lon>{lon}</Lon></ICP>
<ICP index="2:FRLC"><Lat>{lat}</Lat><Lon>{lon}</Lon></ICP>
<ICP index="3:LRLC"><Lat>{lat}</Lat><Lon>{lon}</Lon></ICP>
<ICP index="4:LRFC"><Lat>{lat}</Lat><Lon>{lon}</Lon></ICP>
</ImageCorners></GeoData>
<Grid><ImagePlane>{plane}</ImagePlane><Type>PLANE</Type>
<Row><UVectECF><X>{r[0]!r}</X><Y>{r[1]!r}</Y><Z>{r[2]!r}</Z></UVectECF><SS>{step!r}</SS></Row>
<Col><UVectECF><X>{c[0]!r}</X><Y>{c[1]!r}</Y><Z>{c[2]!r}</Z></UVectECF><SS>{step!r}</SS></Col></Grid>
<Timeline><CollectStart>2026-05-01T12:00:00Z</CollectStart><CollectDuration>1</CollectDuration></Timeline>
<SCPCOA><SCPTime>0</SCPTime><ARPPos><X>{x}</X><Y>{y}</Y><Z>7e6</Z></ARPPos>
<ARPVel><X>1</X><Y>1</Y><Z>0</Z></ARPVel><ARPAcc><X>0</X><Y>0</Y><Z>0</Z></ARPAcc>
<SideOfTrack>L</SideOfTrack></SCPCOA>
</SICD>"""


def sicd(
    image: CoherentImage, folder: Path, plane: str = "GROUND", turn_rad: float = 0.0
) -> tuple[Path, Page]:
    """Write a SICD whose rows lead east and whose columns lead north."""
    import lxml.etree
    import sarkit.sicd

    lat, lon = math.radians(PLACE[0]), math.radians(PLACE[1])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    pixels = np.ascontiguousarray(image.pixels[::-1].T)
    grid = image.grid
    # Its reference point is a whole pixel: here not the scene's origin, which lies between pixels.
    col, row = 200, 300
    at = grid.x_min_m + col * grid.spacing_m, grid.y_max_m - row * grid.spacing_m, 0.0
    to_earth = pyproj.Transformer.from_pipeline(_FROM_SCENE)
    longitude, latitude, altitude = to_earth.transform(*at)
    x, y, z = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(latitude, longitude, altitude)
    text = _SICD.format(
        rows=grid.cols,
        cols=grid.rows,
        row=10 + col,
        col=20 + grid.rows - 1 - row,
        **{"lat": latitude, "lon": longitude, "alt": altitude, "x": x, "y": y, "z": z},
        plane=plane,
        r=(c * east + s * north).tolist(),
        c=(c * north - s * east).tolist(),
        step=grid.spacing_m,
    )
    security = {"security": sarkit.sicd.NitfSecurityFields(clas="U")}
    metadata = sarkit.sicd.NitfMetadata(
        xmltree=lxml.etree.ElementTree(lxml.etree.fromstring(text)),
        file_header_part={"ostaid": "here", **security},
        im_subheader_part={"isorce": "here", **security},
        de_subheader_part=security,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it has not all that the schema asks of a radar
        with (
            (folder / "image.ntf").open("wb") as file,
            sarkit.sicd.NitfWriter(file, metadata) as writer,
        ):
            writer.write_image(pixels.astype(np.complex64))
    return folder / "image.ntf", {"origin": ORIGIN}


# -- navigation -------------------------------------------------------------------------------------


def write_csv(path: Path, header: list[str], rows: Any, delimiter: str = ",") -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow(header)
        writer.writerows(rows)


def seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def csv_scene(track: Track, folder: Path) -> tuple[Path, Page]:
    rows = [[s, *map(repr, p)] for s, p in zip(track.stamps_ns, track.positions_m.tolist(), strict=True)]
    write_csv(folder / "nav.csv", ["time_ns", "x", "y", "z"], rows)
    return folder / "nav.csv", {"track": {"axes": "scene"}}


def csv_ned(track: Track, folder: Path) -> tuple[Path, Page]:
    """Write north, east and down under other names, from elsewhere and shuffled, with one pose twice."""
    rows = [
        [f"{y + 1024.0!r}", f"{x - 512.0!r}", f"{64.0 - z!r}", seconds(s)]
        for s, (x, y, z) in zip(track.stamps_ns.tolist(), track.positions_m.tolist(), strict=True)
    ]
    write_csv(folder / "nav.csv", ["N", "E", "depth", "when"], [*rows[5:], *rows[:6]], ";")
    columns = {"north": "N", "east": "E", "down": "depth", "time": "when"}
    origin = [1024.0, -512.0, 64.0]
    page = {"axes": "ned", "columns": columns, "time_unit": "s", "origin_m": origin}
    return folder / "nav.csv", {"track": page}


def places_of(track: Track) -> Any:
    """Return latitudes, longitudes and altitudes of a track whose scene is at PLACE, by PROJ alone."""
    to_earth = pyproj.Transformer.from_pipeline(_FROM_SCENE)
    longitudes, latitudes, altitudes = to_earth.transform(*track.positions_m.T)
    return latitudes, longitudes, altitudes


def csv_geographic(track: Track, folder: Path) -> tuple[Path, Page]:
    latitudes, longitudes, altitudes = places_of(track)
    rows = [
        [
            f"{datetime.fromtimestamp(s // 10**9, timezone.utc):%Y-%m-%dT%H:%M:%S}.{s % 10**9:09d}Z",
            f"{a:.11f}",
            f"{b:.11f}",
            f"{-c:.6f}",
        ]
        for s, a, b, c in zip(track.stamps_ns.tolist(), latitudes, longitudes, altitudes, strict=True)
    ]
    write_csv(folder / "nav.csv", ["utc", "latitude", "longitude", "depth_m"], rows)
    columns = {"time": "utc", "depth": "depth_m"}
    page = {"axes": "geographic", "columns": columns, "time_unit": "iso"}
    return folder / "nav.csv", {"track": page, "origin": ORIGIN}


def make(kind: str, **fields: Any) -> Any:
    return typestore().types[kind](**fields)


def header(stamp: int, frame: str) -> Any:
    time = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def pose(place: Any, turn: Any = (0.0, 0.0, 0.0, 1.0)) -> Any:
    point = make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, place), strict=True)))
    quaternion = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, turn), strict=True)))
    return make("geometry_msgs/msg/Pose", position=point, orientation=quaternion)


def stamped(track: Track) -> Any:
    return zip(track.stamps_ns.tolist(), track.positions_m, strict=True)


def poses(track: Track, folder: Path) -> tuple[Path, Page]:
    with BagWriter(folder / "nav") as writer:
        for stamp, place in stamped(track):
            message = make("geometry_msgs/msg/PoseStamped", header=header(stamp, "map"), pose=pose(place))
            writer.write("/pose", message)
    return folder / "nav", {}


ARM = (0.5, -0.2, 0.3)


def turns_of(track: Track) -> Any:
    """Return headings of a vehicle that rolls and turns on its way."""
    angles = np.stack([track.aspects_rad, 0.2 * np.sin(track.aspects_rad), 0.1 * track.aspects_rad], axis=1)
    return Rotation.from_euler("zyx", angles)


def odometry(track: Track, folder: Path) -> tuple[Path, Page]:
    """Write Odometry of a vehicle whose sonar is not at its origin, which is not the scene's."""
    turns = turns_of(track)
    still = make(
        "geometry_msgs/msg/TwistWithCovariance",
        twist=make(
            "geometry_msgs/msg/Twist",
            linear=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
            angular=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
        ),
        covariance=np.zeros(36),
    )
    with BagWriter(folder / "nav") as writer:
        for (stamp, place), turn in zip(stamped(track), turns, strict=True):
            body = place + np.array([100.0, 200.0, -30.0]) - turn.apply(ARM)
            here = make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=pose(body, turn.as_quat()),
                covariance=np.zeros(36),
            )
            message = make(
                "nav_msgs/msg/Odometry",
                header=header(stamp, "odom"),
                child_frame_id="base_link",
                pose=here,
                twist=still,
            )
            writer.write("/odom", message)
            writer.write("/odom_raw", message)
    page = {"topic": "/odom", "origin_m": [100.0, 200.0, -30.0], "lever_arm_m": list(ARM)}
    return folder / "nav", {"track": page}


def fixes(track: Track, folder: Path) -> tuple[Path, Page]:
    status = make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
    with BagWriter(folder / "nav") as writer:
        for stamp, a, b, c in zip(track.stamps_ns.tolist(), *places_of(track), strict=True):
            message = make(
                "sensor_msgs/msg/NavSatFix",
                header=header(stamp, "gps"),
                status=status,
                latitude=float(a),
                longitude=float(b),
                altitude=float(c),
                position_covariance=np.zeros(9),
                position_covariance_type=0,
            )
            writer.write("/fix", message)
    return folder / "nav", {"origin": ORIGIN}


def transforms(track: Track, folder: Path) -> tuple[Path, Page]:
    """Write map → odom (static) → base_link → sonar (static): the chain that a robot has."""
    turns = turns_of(track)
    odom = Rotation.from_euler("z", 30.0, degrees=True)

    def transform(stamp: int, parent: str, child: str, place: Any, turn: Any) -> Any:
        moved = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, place), strict=True)))
        both = make("geometry_msgs/msg/Transform", translation=moved, rotation=pose(place, turn).orientation)
        one = make(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp, parent),
            child_frame_id=child,
            transform=both,
        )
        return make("tf2_msgs/msg/TFMessage", transforms=[one])

    first = int(track.stamps_ns[0])
    with BagWriter(folder / "nav") as writer:
        fixed = [
            transform(first, "map", "odom", (1.0, 2.0, 0.0), odom.as_quat()),
            transform(first, "base_link", "sonar", ARM, (0.0, 0.0, 0.0, 1.0)),
        ]
        for message in fixed:
            writer.write("/tf_static", message, first)
        for (stamp, place), turn in zip(stamped(track), turns, strict=True):
            body = odom.inv().apply(place - turn.apply(ARM) - (1.0, 2.0, 0.0))
            both = odom.inv() * turn
            writer.write("/tf", transform(stamp, "odom", "base_link", body, both.as_quat()), stamp)
    return folder / "nav", {"track": {"frames": ["map", "sonar"]}}


IMAGES: dict[str, Route] = {
    one.__name__: one
    for one in (
        npy, npy_south_up, npz_by_x, npz_of_parts, mat, mat_73, hdf5, geotiff, geotiff_on_a_chart, sicd
    )
}  # fmt: skip
NAVIGATION: dict[str, Route] = {
    one.__name__: one for one in (csv_scene, csv_ned, csv_geographic, poses, odometry, fixes, transforms)
}
