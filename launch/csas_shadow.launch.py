"""Start the whole graph: `ros2 launch csas_shadow_ros csas_shadow.launch.py bag:=my_run`.

With a `bag` the graph replays it, writes the results folder `results` (grid, mesh, report, figures and a bag
of every topic; `results/<name of the bag>` by default) and ends, as `csas-shadow replay` does.

With `results:=''`, or without a bag, the nodes run until Ctrl-C and their results stay on their topics:
voxel_carver says when all views are in, and Ctrl-C finishes the bag of `out`. Without a bag the graph waits
for somebody to publish: a sonar processor, or `ros2 bag play --delay 5 --wait-for-all-acked 0 my_run` (a
player that ends at once takes the latched image with it). A parameter or bag that is refused ends the
launch with one line that says which.
"""

import sys
import uuid
from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    OpaqueFunction,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "csas_shadow_ros"
STAGES = ("sub_aperture", "shadow_enhancement", "shadow_likelihood", "voxel_carver")
#: What a node exits with when it refuses its parameters, a bag among them.
REFUSED = 2


def end_if_refused(event, _):
    """End the launch, as a failure, where a restart would only be refused again."""
    if event.returncode == REFUSED:
        # A Shutdown action would end it with the exit status of success.
        raise RuntimeError(f"{event.process_name} refused what it was given; its own line says why")


def end_of_replay(event, _):
    """End the launch with the replay, and as a failure if it failed."""
    if event.returncode:
        raise RuntimeError(f"csas-shadow replay ended with {event.returncode}; its own line says why")
    return [Shutdown(reason="the results are written")]


def start(context):
    """Replay a bag into a results folder, or run the nodes until they are stopped."""
    value = {
        name: LaunchConfiguration(name).perform(context) for name in ("bag", "results", "params", "rate")
    }
    if not value["bag"] or not value["results"]:
        return live_graph()
    results = value["results"] if value["results"] != "auto" else Path("results", Path(value["bag"]).name)
    command = [
        sys.executable,
        "-m",
        f"{PACKAGE}.cli",
        "replay",
        value["bag"],
        "--out",
        str(results),
        "--overwrite",
    ]
    command += ["--params", value["params"], "--rate", value["rate"]]
    return [ExecuteProcess(cmd=command, output="screen", sigterm_timeout="20", on_exit=end_of_replay)]


def live_graph():
    """Describe the nodes."""
    namespace, params = LaunchConfiguration("namespace"), LaunchConfiguration("params")
    bag, out = LaunchConfiguration("bag"), LaunchConfiguration("out")

    def node(name, parameters=None, condition=None):
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=namespace,
            parameters=[params] + ([parameters] if parameters else []),
            condition=condition,
            output="screen",
            # Flow control brings a restarted node everything that it lacks.
            respawn=LaunchConfiguration("respawn"),
            respawn_delay=1.0,
            # On Ctrl-C: the recorder finishes its bag, and a busy machine takes its time.
            sigterm_timeout="20",
            on_exit=end_if_refused,
        )

    playing = {
        "bag": ParameterValue(bag, value_type=str),
        "stage": ParameterValue(LaunchConfiguration("stage"), value_type=str),
        "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
    }
    recording = {"out": ParameterValue(out, value_type=str)}
    return [
        # Who hears another graph in its namespace refuses it by this; a restarted node has the same.
        SetEnvironmentVariable("CSAS_GRAPH_ID", uuid.uuid4().hex[:12]),
        *(node(name) for name in STAGES),
        node("composites", condition=IfCondition(LaunchConfiguration("composites"))),
        node("viewer", condition=IfCondition(LaunchConfiguration("viewer"))),
        node("bag_recorder", recording, IfCondition(NotEqualsSubstitution(out, ""))),
        node("bag_player", playing, IfCondition(NotEqualsSubstitution(bag, ""))),
    ]


def generate_launch_description():
    """Describe the arguments, and the graph that they ask for."""
    share = FindPackageShare(PACKAGE)
    shared_memory = PathJoinSubstitution([share, "config", "fastdds_shm.xml"])
    with_profile = IfCondition(LaunchConfiguration("shared_memory"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", default_value="", description="bag to play; empty: none"),
            DeclareLaunchArgument("stage", default_value="auto", description="which of its stages to play"),
            DeclareLaunchArgument(
                "rate",
                default_value="0.0",
                description="views: times the recorded speed; 0.0: as fast as they are taken",
            ),
            DeclareLaunchArgument(
                "params",
                default_value=PathJoinSubstitution([share, "config", "csas_shadow.yaml"]),
                description="parameter file of all nodes",
            ),
            DeclareLaunchArgument(
                "results", default_value="auto", description="results folder; empty: run until Ctrl-C"
            ),
            DeclareLaunchArgument("out", default_value="", description="bag to record while running live"),
            DeclareLaunchArgument("composites", default_value="true", description="make the composites"),
            DeclareLaunchArgument(
                "viewer", default_value="false", description="the operator's view, in a browser"
            ),
            DeclareLaunchArgument("namespace", default_value="csas", description="namespace of all topics"),
            DeclareLaunchArgument("respawn", default_value="true", description="restart a node that dies"),
            DeclareLaunchArgument(
                "shared_memory", default_value="true", description="Fast DDS profile for large messages"
            ),
            *(
                SetEnvironmentVariable(name, shared_memory, condition=with_profile)
                for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
            ),
            OpaqueFunction(function=start),
        ]
    )
