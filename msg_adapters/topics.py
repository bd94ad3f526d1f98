"""The contract: every topic with its type, encodings and meaning. The one source for all others.

Names are relative to the namespace `NAMESPACE`; `absolute_name` joins the two. An `ImageStream` is
a pair of topics, ``<stream>/image`` and ``<stream>/camera_info`` (no prefix for the full-circle
image), whose messages belong together by their stamps.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

from csas_shadow_ros.core.errors import AdapterError

NAMESPACE = "/csas"

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
PATH = "nav_msgs/msg/Path"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
MARKER = "visualization_msgs/msg/Marker"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

#: Encodings of complex pixels; integers come out as complex64.
COMPLEX_ENCODINGS = ("32FC2", "8SC2", "16SC2", "64FC2")

#: 32FC1, 32FC2, 32FC3 ...: one float channel a height.
VOXEL_ENCODING = "32FCn"

CSAS_IMAGE = "csas_image"
CSAS_SECTOR = "csas_sector"
CSAS_SUB_APERTURE = "csas_sub_aperture"
CSAS_SHADOW = "csas_shadow"
CSAS_VOXEL_GRID = "csas_voxel_grid"

Content = Literal["coherent", "sub_aperture", "amplitude", "likelihood", "mask", "picture", "count"]

_ACOUSTICS = ("centre frequency (Hz)", "bandwidth (Hz)", "sound speed (m/s)", "spectrum_sign (+1 or -1)")
_APERTURE = (
    "aspect (rad)",
    "aperture width (rad)",
    "carrier kx (rad/m)",
    "carrier ky (rad/m)",
    "focus range (m)",
)

#: What each entry of ``CameraInfo.d`` is, by ``distortion_model``.
D_ENTRIES: dict[str, tuple[str, ...]] = {
    CSAS_IMAGE: _ACOUSTICS,
    CSAS_SECTOR: _ACOUSTICS + _APERTURE,
    CSAS_SUB_APERTURE: _ACOUSTICS + _APERTURE,
    CSAS_SHADOW: _ACOUSTICS + _APERTURE,
    CSAS_VOXEL_GRID: ("z of the lowest layer (m)", "layer spacing (m)"),
}


@dataclass(frozen=True)
class Topic:
    """One topic of the contract.

    Parameters
    ----------
    name : str
        Name relative to the namespace; absolute if it starts with a slash.
    type_name : str
        Message type, ``package/msg/Name``.
    description : str
        What it holds.
    encodings : tuple of str
        Allowed ``Image.encoding``, the preferred one first; empty for other types.
    distortion_models : tuple of str
        Allowed ``CameraInfo.distortion_model``; empty for other types.
    """

    name: str
    type_name: str
    description: str
    encodings: tuple[str, ...] = ()
    distortion_models: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImageStream:
    """An image topic and its camera_info topic.

    Parameters
    ----------
    name : str
        ``image`` for the full-circle image, else the topics' prefix (``likelihood``).
    encodings : tuple of str
        Allowed encodings, the preferred one first.
    distortion_model : str
        The kind of camera_info.
    content : str
        Which rule the pixels obey.
    description : str
        What it holds.
    """

    name: str
    encodings: tuple[str, ...]
    distortion_model: str
    content: Content
    description: str

    @property
    def image_topic(self) -> str:
        """Name of the image topic, relative to the namespace."""
        return "image" if self.name == "image" else f"{self.name}/image"

    @property
    def info_topic(self) -> str:
        """Name of the camera_info topic, relative to the namespace."""
        return "camera_info" if self.name == "image" else f"{self.name}/camera_info"


STREAMS: dict[str, ImageStream] = {
    s.name: s
    for s in (
        ImageStream(
            "image",
            COMPLEX_ENCODINGS,
            CSAS_IMAGE,
            "coherent",
            "full-circle coherent complex image, ground plane, north up",
        ),
        ImageStream(
            "sector",
            ("32FC2", "16SC2", "8SC2"),
            CSAS_SECTOR,
            "coherent",
            "coherent baseband ground-plane image of one arc; all arcs on their carriers sum to the image",
        ),
        ImageStream(
            "sub_aperture", ("32FC2",), CSAS_SUB_APERTURE, "sub_aperture", "complex baseband view, view frame"
        ),
        ImageStream(
            "shadow", ("32FC1",), CSAS_SHADOW, "amplitude", "amplitude after shadow enhancement, view frame"
        ),
        ImageStream(
            "likelihood",
            ("32FC1",),
            CSAS_SHADOW,
            "likelihood",
            "likelihood of lying outside the shadow, 0 to 1; NaN where the view knows nothing",
        ),
        ImageStream(
            "shadow_mask",
            ("mono8",),
            CSAS_SHADOW,
            "mask",
            "segmented target shadow: 255 shadow, 0 not, 128 unknown, 64 covered",
        ),
        ImageStream(
            "multilook", ("32FC1",), CSAS_IMAGE, "amplitude", "multilook amplitude over the circle, north up"
        ),
        ImageStream("color_by_aspect", ("rgb8",), CSAS_IMAGE, "picture", "hue by aspect, north up"),
        ImageStream(
            "voxel_grid",
            (VOXEL_ENCODING,),
            CSAS_VOXEL_GRID,
            "likelihood",
            "dense voxel grid: rows y (north up), columns x, one channel a height",
        ),
        ImageStream(
            "voxel_views",
            (VOXEL_ENCODING,),
            CSAS_VOXEL_GRID,
            "count",
            "how many views know something of each voxel, on the lattice of voxel_grid",
        ),
        ImageStream(
            "matter",
            (VOXEL_ENCODING,),
            CSAS_VOXEL_GRID,
            "count",
            "1 where the object holds matter, 0 elsewhere and in hollows, on the lattice of voxel_grid",
        ),
    )
}

#: Streams whose images are views (a view frame and a sonar).
VIEW_STREAMS = ("sub_aperture", "shadow", "likelihood", "shadow_mask")


def _topics() -> dict[str, Topic]:
    topics: list[Topic] = []
    for s in STREAMS.values():
        topics.append(Topic(s.image_topic, IMAGE, s.description, encodings=s.encodings))
        topics.append(
            Topic(
                s.info_topic,
                CAMERA_INFO,
                f"geometry and band of {s.image_topic}, same stamp",
                distortion_models=(s.distortion_model,),
            )
        )
    topics += [
        Topic("track", PATH, "sonar poses along the circle, stamped, in csas_scene"),
        Topic("target", MARKER, "the carved volume as a CUBE; action DELETE: no object"),
        Topic("voxels", POINT_CLOUD, "voxels that may be object: x y z l_out views"),
        Topic("mesh", MARKER, "TRIANGLE_LIST of the thresholded surface; action DELETE: no object"),
        Topic("matter/mesh", MARKER, "TRIANGLE_LIST of the surface without hollows; action DELETE: none"),
        Topic("objects", MARKERS, "an oriented CUBE and a TEXT an object; action DELETE for what is gone"),
        Topic("measurements", DIAGNOSTICS, "each object and the run: values, intervals, verdict"),
        Topic("evidence", DIAGNOSTICS, "a status a view in the grid: levels, and the height it tells"),
        Topic("search", DIAGNOSTICS, "what is carved: the target, further bodies, and what was left out"),
        Topic("progress", DIAGNOSTICS, "what became of each view, and the nodes' heartbeats"),
        Topic("/diagnostics", DIAGNOSTICS, "views in, out, rejected and why, rates"),
    ]
    return {t.name: t for t in topics}


#: Every topic, by its name relative to the namespace.
TOPICS: dict[str, Topic] = _topics()


#: Topics of a grid, which further objects and the other method have too, each under its prefix.
GRID_TOPICS = (
    *(f"{s}/{part}" for s in ("voxel_grid", "voxel_views") for part in ("camera_info", "image")),
    "voxels",
    "mesh",
)
#: Topics of a run's result, without those of further objects.
RESULT_TOPICS = (
    *GRID_TOPICS,
    "matter/camera_info",
    "matter/image",
    "matter/mesh",
    "objects",
    "measurements",
    "evidence",
)
#: Prefix of the grid by the other method.
OTHER_METHOD = "other_method"
_PREFIX = re.compile(rf"(object_(?:[2-9]|[1-5]\d|6[0-4])|{OTHER_METHOD})/(.+)")
#: Topics whose last message holds until another one comes.
_LATCHED = frozenset(
    {"image", "camera_info", "track", "target", "search", *RESULT_TOPICS}
    | {f"{s}/{part}" for s in ("multilook", "color_by_aspect") for part in ("camera_info", "image")}
)


def prefixed(prefix: str, name: str) -> str:
    """Return the name of a grid's topic under a prefix (``object_2``), or as it is under none."""
    return f"{prefix}/{name}" if prefix else name


def split_prefix(name: str) -> tuple[str, str]:
    """Split a topic, or stream, into its prefix (``object_2``, ``other_method`` or none) and the rest.

    Examples
    --------
    >>> split_prefix("object_2/voxel_grid/image")
    ('object_2', 'voxel_grid/image')
    >>> split_prefix("voxels")
    ('', 'voxels')
    """
    match = _PREFIX.fullmatch(name)
    if match and any(t == match.group(2) or t.startswith(f"{match.group(2)}/") for t in GRID_TOPICS):
        return match.group(1), match.group(2)
    return "", name


def topic(name: str) -> Topic:
    """Return a topic of the contract by its relative name, with or without a prefix.

    Raises
    ------
    AdapterError
        If there is none.
    """
    found = TOPICS.get(split_prefix(name)[1])
    if found is None:
        raise AdapterError(f"there is no topic {name!r}; expected one of: {', '.join(TOPICS)}")
    return replace(found, name=name)


def is_topic(name: str) -> bool:
    """Say whether the contract has a topic of that relative name."""
    return split_prefix(name)[1] in TOPICS


def is_latched(name: str) -> bool:
    """Say whether the last message of a topic holds until another one comes."""
    return split_prefix(name)[1] in _LATCHED


def stream(name: str) -> ImageStream:
    """Return the image stream of that name, with or without a prefix.

    Raises
    ------
    AdapterError
        If there is none.
    """
    found = STREAMS.get(split_prefix(name)[1])
    if found is None:
        raise AdapterError(f"there is no image stream {name!r}; expected one of: {', '.join(STREAMS)}")
    return found if found.name == name else replace(found, name=name)


def absolute_name(name: str, namespace: str = NAMESPACE) -> str:
    """Join a namespace and a relative topic name; an absolute name is returned as it is."""
    return name if name.startswith("/") else f"{clean_namespace(namespace)}/{name}"


def clean_namespace(namespace: str) -> str:
    """Return a namespace with one leading and no trailing slash; '' for the root."""
    stripped = namespace.strip("/")
    return f"/{stripped}" if stripped else ""


def topic_table() -> str:
    """Write the contract's topics as a markdown table, for the README."""
    lines = ["| topic | type | encoding or kind | holds |", "|---|---|---|---|"]
    for topic in TOPICS.values():
        package, _, name = topic.type_name.split("/")
        kind = ", ".join(topic.encodings or topic.distortion_models)
        lines.append(f"| `{topic.name}` | {package}/{name} | {kind} | {topic.description} |")
    grid = "`voxel_grid/*`, `voxel_views/*`, `voxels`, `mesh`"
    lines.append(f"| `object_N/…` | as without prefix | | {grid} of objects 2, 3, … |")
    lines.append(f"| `{OTHER_METHOD}/…` | as without prefix | | {grid} by the other method, if asked for |")
    return "\n".join(lines) + "\n"
