"""Start the whole graph: `ros2 launch csas_shadow_ros csas_shadow.launch.py bag:=my_run`.

With a `bag` the graph replays it, writes the results folder `results` (grid, mesh, report, figures and a bag
of every topic; `results/<name of the bag>` by default) and ends, as `csas-shadow replay` does.

With `results:=none`, or without a bag, the nodes run until Ctrl-C and their results stay on their topics:
voxel_carver says when all views are in, and Ctrl-C finishes the bag of `out`. Without a bag the graph waits
for somebody to publish: a sonar processor, or `ros2 bag play --delay 5 --wait-for-all-acked 0 my_run` (a
player that ends at once takes the latched image with it). A parameter or bag that is refused ends the
launch with one line that says which, and so does an argument that would go nowhere.

Several vehicles in one domain have a namespace and a frame each:
`namespace:=auv_1 scene_frame:=auv_1/scene`.

The nodes find, and are found by, this machine's nodes alone. `discovery_range:=SUBNET`, or
ROS_AUTOMATIC_DISCOVERY_RANGE in the environment, lets others take part.
"""

import os
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
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

from csas_shadow_ros.node_table import chain
from launch import LaunchDescription

PACKAGE, FILE = "csas_shadow_ros", "csas_shadow.launch.py"
STAGES = chain("image")
#: What a node exits with when it refuses its parameters, a bag among them.
REFUSED = 2
SHARE = FindPackageShare(PACKAGE)
#: What can be started, and so who is meant by an argument.
REPLAY, PLAY, LIVE = "a replay into a results folder", "nodes that play a bag", "nodes without a bag"
ALL, NODES = (REPLAY, PLAY, LIVE), (PLAY, LIVE)
#: Default, who takes it, and what it is. "none" is empty: ros2 launch takes no empty value.
ARGUMENTS = {
    "bag": ("none", ALL, "bag to play"),
    "results": ("auto", (REPLAY, PLAY), "results folder; none: run until Ctrl-C"),
    "expect": ("none", (REPLAY,), "file of values that the results must have, as of csas-shadow replay"),
    "stage": ("auto", (REPLAY, PLAY), "which of the bag's stages to play"),
    "rate": ("0.0", (REPLAY, PLAY), "views: times the recorded speed; 0.0: as fast as they are taken"),
    "params": (PathJoinSubstitution([SHARE, "config", "csas_shadow.yaml"]), ALL, "parameters of all nodes"),
    "domain_id": ("none", ALL, "ROS domain; none: that of ROS_DOMAIN_ID, of a replay one that nobody uses"),
    "discovery_range": (
        "auto",
        NODES,
        "whose nodes are found: LOCALHOST, SUBNET, OFF or SYSTEM_DEFAULT; auto: what"
        " ROS_AUTOMATIC_DISCOVERY_RANGE says, else LOCALHOST",
    ),
    "origin_lat_deg": ("none", ALL, "latitude of the scene's origin, WGS-84; none: topic origin says it"),
    "origin_lon_deg": ("none", ALL, "its longitude"),
    "origin_heading_deg": ("none", ALL, "true bearing of the scene's y axis, clockwise; none: north"),
    "scene_frame": ("none", NODES, "frame that all messages of a run must be in; none: any one"),
    "parent_frame": ("none", NODES, "frame that scene_transform leads to; none: earth"),
    "namespace": ("csas", NODES, "namespace of all topics"),
    "use_sim_time": ("false", NODES, "go by /clock"),
    "out": ("none", NODES, "bag to record"),
    "composites": ("true", NODES, "make the composites"),
    "viewer": ("false", NODES, "the operator's view, in a browser"),
    "respawn": ("true", NODES, "restart a node that dies"),
    "shared_memory": ("true", NODES, "Fast DDS profile for large messages"),
}
#: What ROS_AUTOMATIC_DISCOVERY_RANGE may be; rcl warns of any other value and takes the whole subnet.
RANGE, RANGES = "ROS_AUTOMATIC_DISCOVERY_RANGE", ("LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT")
FLAGS = [name for name, (default, *_) in ARGUMENTS.items() if default in ("true", "false")]


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


def number(name, text):
    """Read a number that was given."""
    try:
        return float(text)
    except ValueError:
        raise RuntimeError(f"{name} is {text!r}; expected a number") from None


def truth(name, text):
    """Read true or false."""
    if text.lower() not in ("true", "false"):
        raise RuntimeError(f"{name} is {text!r}; expected true or false")
    return text.lower() == "true"


def discovery_range(text):
    """Return whose nodes are found: what is asked for, what the user's shell says, or this machine's."""
    asked = os.environ.get(RANGE) or "LOCALHOST" if text == "auto" else text
    if asked.upper() not in RANGES:
        name = RANGE if text == "auto" else "discovery_range"
        raise RuntimeError(f"{name} is {asked!r}; expected one of: {', '.join(RANGES)}")
    return asked.upper()


def start(context):
    """Replay a bag into a results folder, or run the nodes until they are stopped."""
    if any(Path(word).name == FILE for word in sys.argv):
        # Nobody includes this file: what the command line says is meant for it.
        for name in (word.partition(":=")[0] for word in sys.argv if ":=" in word):
            if name not in ARGUMENTS:
                raise RuntimeError(f"there is no argument {name!r}; expected one of: {', '.join(ARGUMENTS)}")
    given, default = {}, {}
    for name, (value, _, _) in ARGUMENTS.items():
        text = LaunchConfiguration(name).perform(context)
        default[name] = value if isinstance(value, str) else value.perform(context)
        # A shell that was told '' twice passes the quotation marks on.
        given[name] = "none" if text.strip("'\"") in ("", "none") else text
    mode = LIVE if given["bag"] == "none" else PLAY if given["results"] == "none" else REPLAY
    for name, (_, taken_by, _) in ARGUMENTS.items():
        if given[name] != default[name] and mode not in taken_by:
            who = " or ".join(taken_by)
            raise RuntimeError(f"{name} is {given[name]!r}, which {mode} cannot take; expected it with {who}")
    value = {name: "" if text == "none" else text for name, text in given.items()}
    return replay(value) if mode == REPLAY else nodes(value, play=mode == PLAY)


def replay(value):
    """Describe the process of a replay, and the launch's end with it."""
    results = value["results"] if value["results"] != "auto" else Path("results", Path(value["bag"]).name)
    # As nodes are found: the Python of ros2 itself, apt's, sees nothing of an environment beside it.
    command = [ExecutableInPackage("csas-shadow", PACKAGE), "replay", value["bag"], "--out", str(results)]
    command += ["--overwrite", "--params", value["params"], "--rate", value["rate"]]
    command += ["--start-from", value["stage"]]
    for name in ("expect", "domain_id", "origin_lat_deg", "origin_lon_deg", "origin_heading_deg"):
        if value[name]:
            command.append(f"--{name.replace('_', '-')}={value[name]}")
    return [ExecuteProcess(cmd=command, output="screen", sigterm_timeout="20", on_exit=end_of_replay)]


def nodes(value, *, play):
    """Describe the nodes."""
    flags = {n: truth(n, value[n]) for n in FLAGS}

    def node(name, **parameters):
        common = {"use_sim_time": flags["use_sim_time"]}
        if value["scene_frame"]:
            common["scene_frame"] = value["scene_frame"]
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=value["namespace"],
            # Whose keys it has, where ROS_SECURITY_ENABLE asks for them (docs/security.md).
            ros_arguments=["--enclave", f"/{value['namespace']}/{name}".replace("//", "/")],
            parameters=[value["params"], common | parameters],
            output="screen",
            # Flow control brings a restarted node everything that it lacks.
            respawn=flags["respawn"],
            respawn_delay=1.0,
            # On Ctrl-C: the recorder finishes its bag, and a busy machine takes its time.
            sigterm_timeout="20",
            on_exit=end_if_refused,
        )

    place = {n: number(n, value[n]) for n in ARGUMENTS if n.startswith("origin_") and value[n]}
    if value["parent_frame"]:
        place["parent_frame"] = value["parent_frame"]
    # Who hears another graph in its namespace refuses it by this; a restarted node has the same.
    environment = {"CSAS_GRAPH_ID": uuid.uuid4().hex[:12]}
    # Whoever may publish in a graph may stop it, or feed it: by default that is nobody elsewhere.
    environment[RANGE] = discovery_range(value["discovery_range"])
    if value["domain_id"]:
        environment["ROS_DOMAIN_ID"] = value["domain_id"]
    if flags["shared_memory"]:
        profile = PathJoinSubstitution([SHARE, "config", "fastdds_shm.xml"])
        environment |= {"FASTRTPS_DEFAULT_PROFILES_FILE": profile, "FASTDDS_DEFAULT_PROFILES_FILE": profile}
    made = [node(name) for name in STAGES[:-1]] + [node(STAGES[-1], **place)]
    if flags["composites"]:
        made.append(node("composites"))
    if flags["viewer"]:
        made.append(node("viewer"))
    if value["out"]:
        made.append(node("bag_recorder", out=value["out"]))
    if play:
        rate = number("rate", value["rate"])
        made.append(node("bag_player", bag=value["bag"], stage=value["stage"], rate=rate))
    return [*(SetEnvironmentVariable(name, text) for name, text in environment.items()), *made]


def generate_launch_description():
    """Describe the arguments, and the graph that they ask for."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, _, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
