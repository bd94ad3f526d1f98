"""Start the whole graph: `ros2 launch csas_shadow_ros csas_shadow.launch.py bag:=my_run`.

Without `bag` the graph waits for somebody to publish: a sonar processor, or
`ros2 bag play --delay 5 --wait-for-all-acked 0 my_run` (a player that ends at once takes the latched
image with it).

The graph runs until Ctrl-C, so that its results stay on their topics; voxel_carver says when all views
are in. Ctrl-C finishes the bag of `out`. A parameter or bag that is refused ends the launch with one line
that says which.
"""

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
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


def generate_launch_description():
    """Describe the graph."""
    share = FindPackageShare(PACKAGE)
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
    shared_memory = PathJoinSubstitution([share, "config", "fastdds_shm.xml"])
    with_profile = IfCondition(LaunchConfiguration("shared_memory"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", default_value="", description="bag to play; empty: none"),
            DeclareLaunchArgument("stage", default_value="auto", description="which of its stages to play"),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="views: times the recorded speed; 0.0: unlimited"
            ),
            DeclareLaunchArgument(
                "params",
                default_value=PathJoinSubstitution([share, "config", "csas_shadow.yaml"]),
                description="parameter file of all nodes",
            ),
            DeclareLaunchArgument("out", default_value="", description="bag to record; empty: none"),
            DeclareLaunchArgument("composites", default_value="true", description="make the composites"),
            DeclareLaunchArgument("namespace", default_value="csas", description="namespace of all topics"),
            DeclareLaunchArgument("respawn", default_value="true", description="restart a node that dies"),
            DeclareLaunchArgument(
                "shared_memory", default_value="true", description="Fast DDS profile for large messages"
            ),
            *(
                SetEnvironmentVariable(name, shared_memory, condition=with_profile)
                for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
            ),
            *(node(name) for name in STAGES),
            node("composites", condition=IfCondition(LaunchConfiguration("composites"))),
            node("bag_recorder", recording, IfCondition(NotEqualsSubstitution(out, ""))),
            node("bag_player", playing, IfCondition(NotEqualsSubstitution(bag, ""))),
        ]
    )
