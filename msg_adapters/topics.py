"""The contract: every topic with its type, encodings and meaning. The one source for all others.

Names are relative to the namespace `NAMESPACE`; `absolute_name` joins the two. An `ImageStream` is
a pair of topics, ``<stream>/image`` and ``<stream>/camera_info`` (no prefix for the full-circle
image), whose messages belong together by their stamps.

What a run publishes of its target exists for further objects and for the other method's grid, too, under a
prefix: ``object_2/voxel_grid/image``, ``other_method/voxels``. `TOPICS` and `STREAMS` hold names without a
prefix; `topic` and `stream` take both kinds.
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
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
TRANSFORM = "geometry_msgs/msg/TransformStamped"

#: Encodings of complex pixels; integers come out as complex64.
COMPLEX_ENCODINGS = ("32FC2", "8SC2", "16SC2", "64FC2")

#: 32FC1, 32FC2, 32FC3 ...: one float channel a height.
VOXEL_ENCODING = "32FCn"
#: 8UC1, 8UC2 ...: one byte channel a height.
MATTER_ENCODING = "8UCn"

CSAS_IMAGE = "csas_image"
CSAS_SECTOR = "csas_sector"
CSAS_SUB_APERTURE = "csas_sub_aperture"
CSAS_SHADOW = "csas_shadow"
CSAS_VOXEL_GRID = "csas_voxel_grid"

Content = Literal["coherent", "sub_aperture", "amplitude", "likelihood", "mask", "picture", "count", "matter"]

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
            "dense voxel grid: rows y (north up), columns x, one channel per height",
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
            (MATTER_ENCODING,),
            CSAS_VOXEL_GRID,
            "matter",
            "which voxels hold matter: 255, others 0; the object without its hollows, on the same lattice",
        ),
    )
}

#: Streams whose images are views (a view frame and a sonar).
VIEW_STREAMS = ("sub_aperture", "shadow", "likelihood", "shadow_mask")
#: Streams whose images are voxels: a channel a height.
VOXEL_STREAMS = tuple(s.name for s in STREAMS.values() if s.distortion_model == CSAS_VOXEL_GRID)


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
        Topic(
            "shadow/display",
            IMAGE,
            "shadow/image for the eye: 1 to 255 is -25 to +15 dB over the view's median, 0 NaN; made while"
            " somebody looks",
            encodings=("mono8",),
        ),
        Topic("track", PATH, "sonar poses along the circle, stamped, in the scene's frame"),
        Topic("target", MARKER, "the carved volume as a CUBE; action DELETE: no object"),
        Topic("voxels", POINT_CLOUD, "voxels that may be object: x y z l_out views"),
        Topic("mesh", MARKER, "TRIANGLE_LIST of the thresholded surface; action DELETE: no object"),
        Topic(
            "matter/mesh",
            MARKER,
            "TRIANGLE_LIST of the surface without hollows; action DELETE: mesh is that surface",
        ),
        Topic("objects", MARKERS, "each object as an oriented CUBE and a label; DELETE: gone"),
        Topic("measurements", DIAGNOSTICS, "measures of each object, verdict and quality of the run"),
        Topic("evidence", DIAGNOSTICS, "what each view contributed to the grid: one status per view"),
        Topic("search", DIAGNOSTICS, "what to carve, and what is left out and why"),
        Topic("origin", NAV_SAT_FIX, "position on earth of the scene's origin, with its covariance"),
        Topic("scene_transform", TRANSFORM, "the scene's frame in parent_frame, if there is a datum"),
        Topic("progress", DIAGNOSTICS, "the fate of each view, and the nodes' heartbeats"),
        Topic("/diagnostics", DIAGNOSTICS, "views in, out, rejected and why, rates"),
    ]
    return {t.name: t for t in topics}


#: Every topic, by its name relative to the namespace.
TOPICS: dict[str, Topic] = _topics()


#: Pictures of other topics, for the eye: who records everything has those topics, and does without.
DISPLAYS: frozenset[str] = frozenset({"shadow/display"})

#: Of the other method's grid.
OTHER_METHOD = "other_method"
#: Numbers that a further object can have; the target is number 1 and has no prefix.
FIRST_FURTHER, LAST_FURTHER = 2, 64
#: Streams, and other topics, that exist under a prefix too.
PREFIXED_STREAMS = ("voxel_grid", "voxel_views")
PREFIXED_TOPICS = (
    *(t for s in PREFIXED_STREAMS for t in (STREAMS[s].image_topic, STREAMS[s].info_topic)),
    "voxels",
    "mesh",
)
_PREFIX = re.compile(rf"({OTHER_METHOD}|object_[1-9]\d?)/(.+)")

_LATCHED_STREAMS = ("image", "multilook", "color_by_aspect", *VOXEL_STREAMS)
#: Topics whose last message stays: whoever comes late gets it. Names without a prefix.
LATCHED: frozenset[str] = frozenset(
    {"track", "target", "voxels", "mesh", "matter/mesh", "objects", "measurements", "evidence", "search"}
    | {"origin", "scene_transform"}
    | {t for s in _LATCHED_STREAMS for t in (STREAMS[s].image_topic, STREAMS[s].info_topic)}
)


def object_prefix(number: int) -> str:
    """Return the prefix of an object's topics: '' for the target, number 1.

    Raises
    ------
    AdapterError
        If no object can have that number.
    """
    if not 1 <= number <= LAST_FURTHER:
        raise AdapterError(f"object number is {number}; expected 1 to {LAST_FURTHER}")
    return "" if number == 1 else f"object_{number}"


def split_prefix(name: str) -> tuple[str, str]:
    """Split a topic's or a stream's name into its prefix ('' if it has none) and the rest.

    A prefix that the contract does not know is none: ``object_1/mesh`` stays as it is.
    """
    match = _PREFIX.fullmatch(name)
    return (match[1], match[2]) if match and _is_prefix(match[1]) else ("", name)


def _is_prefix(prefix: str) -> bool:
    if prefix == OTHER_METHOD:
        return True
    word, _, number = prefix.partition("_")
    return word == "object" and number.isdecimal() and FIRST_FURTHER <= int(number) <= LAST_FURTHER


#: Topics of a run's result, without those of further objects and of the other method.
RESULT_TOPICS = (*PREFIXED_TOPICS, "matter/camera_info", "matter/image", "matter/mesh")
RESULT_TOPICS += ("objects", "evidence", "measurements")


def prefixed(prefix: str, name: str) -> str:
    """Put a prefix before a topic's or a stream's name; '' leaves it unchanged.

    Raises
    ------
    AdapterError
        If there is no such prefix, or the name does not exist under one.
    """
    if not prefix:
        return name
    if not _is_prefix(prefix):
        raise AdapterError(
            f"prefix is {prefix!r}; expected object_{FIRST_FURTHER} to object_{LAST_FURTHER},"
            f" or {OTHER_METHOD}"
        )
    if name not in (*PREFIXED_TOPICS, *PREFIXED_STREAMS):
        raise AdapterError(
            f"{name!r} does not exist under {prefix}; expected one of: {', '.join(PREFIXED_TOPICS)}"
        )
    return f"{prefix}/{name}"


def topic(name: str) -> Topic:
    """Return the topic of that name, relative to the namespace, with or without a prefix.

    Raises
    ------
    AdapterError
        If there is none.
    """
    prefix, rest = split_prefix(name)
    if rest not in (PREFIXED_TOPICS if prefix else TOPICS):
        raise AdapterError(
            f"there is no topic {name!r}; expected one of: {', '.join(TOPICS)};"
            f" or, under object_N or {OTHER_METHOD}, one of: {', '.join(PREFIXED_TOPICS)}"
        )
    found = TOPICS[rest]
    if not prefix:
        return found
    whose = "the other method" if prefix == OTHER_METHOD else prefix.replace("_", " ")
    return replace(found, name=name, description=f"{found.description}; of {whose}")


def is_topic(name: str) -> bool:
    """Say whether the contract has a topic of that relative name, with or without a prefix."""
    prefix, rest = split_prefix(name)
    return rest in (PREFIXED_TOPICS if prefix else TOPICS)


def is_latched(name: str) -> bool:
    """Say whether a topic (relative name) keeps its last message for late subscribers."""
    prefix, rest = split_prefix(name)
    return rest in LATCHED and (not prefix or rest in PREFIXED_TOPICS)


def is_result(name: str) -> bool:
    """Say whether a topic (relative name) says what a run came to, again and again as that grows.

    Examples
    --------
    >>> is_result("object_2/voxel_grid/image"), is_result("multilook/image"), is_result("shadow/image")
    (True, True, False)
    """
    rest = split_prefix(name)[1]
    return rest in RESULT_TOPICS or rest.partition("/")[0] in ("multilook", "color_by_aspect")


def stream(name: str) -> ImageStream:
    """Return the image stream of that name, with or without a prefix (``object_2/voxel_grid``).

    Raises
    ------
    AdapterError
        If there is none.
    """
    prefix, rest = split_prefix(name)
    if rest not in (PREFIXED_STREAMS if prefix else STREAMS):
        raise AdapterError(
            f"there is no image stream {name!r}; expected one of: {', '.join(STREAMS)};"
            f" or, under object_N or {OTHER_METHOD}, one of: {', '.join(PREFIXED_STREAMS)}"
        )
    return replace(STREAMS[rest], name=name) if prefix else STREAMS[rest]


def absolute_name(name: str, namespace: str = NAMESPACE) -> str:
    """Join a namespace and a relative topic name; return an absolute name unchanged."""
    return name if name.startswith("/") else f"{clean_namespace(namespace)}/{name}"


def clean_namespace(namespace: str) -> str:
    """Return a namespace with one leading and no trailing slash; '' for the root."""
    stripped = namespace.strip("/")
    return f"/{stripped}" if stripped else ""


def topic_table() -> str:
    """Write the contract's topics as a markdown table, for the README."""
    lines = ["| topic | type | encoding or kind | holds |", "|---|---|---|---|"]
    for one in TOPICS.values():
        package, _, name = one.type_name.split("/")
        kind = ", ".join(one.encodings or one.distortion_models)
        lines.append(f"| `{one.name}` | {package}/{name} | {kind} | {one.description} |")
    sets = (*(f"{s}/*" for s in PREFIXED_STREAMS), "voxels", "mesh")
    for prefix, holds in (
        ("object_N", f"of further objects, N from {FIRST_FURTHER} to {LAST_FURTHER}"),
        (OTHER_METHOD, "of the grid by the other method, if requested"),
    ):
        names = ", ".join(f"`{prefix}/{name}`" for name in sets)
        lines.append(f"| {names} | as without prefix | as without prefix | {holds} |")
    return "\n".join(lines) + "\n"
