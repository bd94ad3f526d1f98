"""Bags: reading and writing runs as rosbag2 directories, and checking them. No ROS needed."""

from .bag import BagMessage, BagReader, BagWriter, TopicInfo, copy, qos_profile
from .check import CheckReport, Finding, check_bag
from .pairs import MessagePair, Problem, iterate_pairs
from .run import Run, read_run, write_run

__all__ = [
    "BagMessage",
    "BagReader",
    "BagWriter",
    "CheckReport",
    "Finding",
    "MessagePair",
    "Problem",
    "Run",
    "TopicInfo",
    "check_bag",
    "copy",
    "iterate_pairs",
    "qos_profile",
    "read_run",
    "write_run",
]
