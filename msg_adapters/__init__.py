"""ROS messages to and from the core's types: a pair of functions a message, and no computing.

Readers (`x_from_msg`) are duck-typed: they take an rclpy message and a rosbags one alike. Writers
(`x_to_msg`) take a `MessageFactory`: `RclpyMessages()` or `RosbagsMessages()`. Nothing here imports
ROS before the first rclpy message is made. Every message that breaks the contract raises one
`AdapterError` with the field, its value and what was expected.
"""

from csas_shadow_ros.core.errors import AdapterError

from .camera_info import (
    GroundInfo,
    SectorInfo,
    check_pair,
    ground_info_from_msg,
    ground_info_to_msg,
    sector_info_from_msg,
    sector_info_to_msg,
    view_info_from_msg,
    view_info_to_msg,
)
from .evidence import evidence_from_msg, evidence_to_msg
from .image import check_pixels, image_from_msg, image_to_msg, pixels_from_msg, quantise
from .measurements import (
    GridFacts,
    MeasuredObject,
    Measurements,
    measurements_from_msg,
    measurements_to_msg,
)
from .mesh import mesh_from_msg, mesh_to_msg
from .messages import (
    SCENE_FRAME,
    MessageFactory,
    RclpyMessages,
    RosbagsMessages,
    data_stamp_to_ns,
    message_from_cdr,
    stamp_from_ns,
    stamp_to_ns,
    type_name_of,
)
from .objects import ObjectBox, objects_from_msg, objects_to_msg
from .pairs import (
    Pairer,
    coherent_image_from_msgs,
    coherent_image_to_msgs,
    ground_picture_from_msgs,
    ground_picture_to_msgs,
    sector_from_msgs,
    sector_to_msgs,
    view_from_msgs,
    view_to_msgs,
    voxel_grid_from_msgs,
    voxel_grid_to_msgs,
)
from .progress import (
    Heartbeat,
    Level,
    ViewProgress,
    diagnostics_to_msg,
    is_routine_report,
    progress_from_msg,
    progress_to_msg,
)
from .result import result_from_msgs, result_to_msgs
from .search import SearchNews, decision_from_msg, decision_to_msg
from .target import TargetBox, target_from_msg, target_may_move, target_to_msg
from .topics import (
    LATCHED,
    NAMESPACE,
    STREAMS,
    TOPICS,
    VIEW_STREAMS,
    VOXEL_STREAMS,
    ImageStream,
    Topic,
    absolute_name,
    is_latched,
    object_prefix,
    prefixed,
    split_prefix,
    stream,
    topic,
)
from .track import track_from_msg, track_piece_from_msg, track_to_msg
from .voxels import Voxels, voxels_from_msg, voxels_to_msg

__all__ = [
    "LATCHED",
    "NAMESPACE",
    "SCENE_FRAME",
    "STREAMS",
    "TOPICS",
    "VIEW_STREAMS",
    "VOXEL_STREAMS",
    "AdapterError",
    "GridFacts",
    "GroundInfo",
    "Heartbeat",
    "ImageStream",
    "Level",
    "MeasuredObject",
    "Measurements",
    "MessageFactory",
    "ObjectBox",
    "Pairer",
    "RclpyMessages",
    "RosbagsMessages",
    "SearchNews",
    "SectorInfo",
    "TargetBox",
    "Topic",
    "ViewProgress",
    "Voxels",
    "absolute_name",
    "check_pair",
    "check_pixels",
    "coherent_image_from_msgs",
    "coherent_image_to_msgs",
    "data_stamp_to_ns",
    "decision_from_msg",
    "decision_to_msg",
    "diagnostics_to_msg",
    "evidence_from_msg",
    "evidence_to_msg",
    "ground_info_from_msg",
    "ground_info_to_msg",
    "ground_picture_from_msgs",
    "ground_picture_to_msgs",
    "image_from_msg",
    "image_to_msg",
    "is_latched",
    "is_routine_report",
    "measurements_from_msg",
    "measurements_to_msg",
    "mesh_from_msg",
    "mesh_to_msg",
    "message_from_cdr",
    "object_prefix",
    "objects_from_msg",
    "objects_to_msg",
    "pixels_from_msg",
    "prefixed",
    "progress_from_msg",
    "progress_to_msg",
    "quantise",
    "result_from_msgs",
    "result_to_msgs",
    "sector_from_msgs",
    "sector_info_from_msg",
    "sector_info_to_msg",
    "sector_to_msgs",
    "split_prefix",
    "stamp_from_ns",
    "stamp_to_ns",
    "stream",
    "target_from_msg",
    "target_may_move",
    "target_to_msg",
    "topic",
    "track_from_msg",
    "track_piece_from_msg",
    "track_to_msg",
    "type_name_of",
    "view_from_msgs",
    "view_info_from_msg",
    "view_info_to_msg",
    "view_to_msgs",
    "voxel_grid_from_msgs",
    "voxel_grid_to_msgs",
    "voxels_from_msg",
    "voxels_to_msg",
]
