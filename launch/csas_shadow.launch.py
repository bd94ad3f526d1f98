"""Start the whole graph: `ros2 launch csas_shadow_ros csas_shadow.launch.py bag:=my_run`.

Without `bag` the graph waits for somebody to publish (`ros2 bag play`, a sonar processor).
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
