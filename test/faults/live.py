"""A live graph of processes that circles one contact after another, under kills; `soak.py` starts it.

Prints a line of JSON at its end: kills, faults, seconds a circle, and the memory of every process.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import random
import shutil
import signal
import statistics
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from soak import STEP_DEG, STREAMS, VOXEL_M, Bags, hash_of

from csas_shadow_ros.bags import read_run
from csas_shadow_ros.client import Reach, create_node
from csas_shadow_ros.core.geometry import Track
from csas_shadow_ros.graph.processes import (
    DomainReservation,
    Graph,
    environment_of,
    new_graph_id,
    start_fork_server,
)
from csas_shadow_ros.nodes import qos
from msg_adapters import (
    Heartbeat,
    RclpyMessages,
    coherent_image_to_msgs,
    measurements_from_msg,
    progress_from_msg,
    topic,
    track_to_msg,
    voxel_grid_from_msgs,
)
from msg_adapters.topics import TOPICS

#: Seconds between the circles of two contacts: more than one takes.
APART_NS = 1000 * 10**9
#: A circle that has not ended by then never will.
PATIENCE_S = 240.0
MESSAGES = RclpyMessages()
PLAN: dict[str, dict[str, Any]] = {
    "sub_aperture": {"step_deg": STEP_DEG, "min_sinks": 2},
    "shadow_enhancement": {},
    "shadow_likelihood": {},
    "voxel_carver": {"voxel_size_m": VOXEL_M, "publish_hz": 0.0},
    "composites": {"publish_hz": 0.0},
    "bag_recorder": {"compression": "lz4", "sync": False},
}


class Vehicle:
    """Publishes what an outside processor would, and listens to what the graph leaves."""

    def __init__(self, graph: Graph, domain: int, namespace: str) -> None:
        self._where = {k: v for k, v in graph.environment.items() if k.startswith(("ROS_", "FAST"))}, domain
        self._namespace = namespace
        self.latest: dict[str, Any] = {}
        #: Hash of the grid, and views used, of each run that was published as final.
        self.final: dict[int | None, tuple[str, int]] = {}
        self.lost: dict[str, int] = {}
        #: Nodes that have spoken.
        self.heard: set[str] = set()
        self._sent: dict[str, Any] = {}
        self._begin()

    def _begin(self) -> None:
        self.context = Context()
        own, domain = self._where
        with environment_of(own):
            rclpy.init(context=self.context, domain_id=domain)
            self.node = create_node("vehicle", context=self.context, namespace=self._namespace)
        self.reach = Reach()
        self.publishers = {
            name: self.node.create_publisher(self._kind(name), name, qos.LATCHED)
            for name in ("image", "camera_info", "track")
        }
        for name in ("voxel_grid/image", "voxel_grid/camera_info", "measurements"):
            self.node.create_subscription(self._kind(name), name, partial(self._take, name), qos.LATCHED)
        kind = MESSAGES.cls(TOPICS["progress"].type_name)
        self.node.create_subscription(kind, "progress", self._hear, qos.REPORTS)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    @staticmethod
    def _kind(name: str) -> Any:
        return MESSAGES.cls(topic(name).type_name)

    def _hear(self, msg: Any) -> None:
        item = progress_from_msg(msg)
        self.heard.add(item.node)
        if isinstance(item, Heartbeat) and item.counts.get("lost"):
            self.lost[item.instance] = item.counts["lost"]

    def _take(self, name: str, message: Any) -> None:
        self.latest[name] = message
        if set(self.latest) < {"voxel_grid/image", "voxel_grid/camera_info", "measurements"}:
            return
        stamps = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in self.latest.values()}
        told = measurements_from_msg(self.latest["measurements"])
        if told.final and len(stamps) == 1:
            image, info = self.latest["voxel_grid/image"], self.latest["voxel_grid/camera_info"]
            self.final[told.run_ns] = hash_of(voxel_grid_from_msgs(image, info)[2]), told.views_used

    def send(self, bag: Any, by_ns: int) -> int:
        """Publish a bag's run as one that was sailed later; return its name."""
        track = Track(bag.require_track().stamps_ns + by_ns, bag.require_track().positions_m)
        image = bag.coherent_image()
        picture, info = coherent_image_to_msgs(MESSAGES, replace(image, stamp_ns=image.stamp_ns + by_ns))
        self._sent = {"track": track_to_msg(MESSAGES, track), "camera_info": info, "image": picture}
        self._say()
        return int(track.stamps_ns[0])

    def _say(self) -> None:
        for name, message in self._sent.items():
            self.publishers[name].publish(message)

    def begins_anew(self) -> bool:
        """Begin again at other ports where others do not reach it, as a program from outside is told to."""
        if not self.reach.is_lost():
            return False
        self.close()
        gc.collect()  # nodes hold their participant until they are collected
        self.reach.take_others()
        self._begin()
        self._say()
        return True

    def close(self) -> None:
        """Go."""
        self.executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


def memory_kb(pid: int) -> int:
    """Return what a process holds in memory of its own: what it shares is not counted."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss_Anon:"):
                return int(line.split()[1])
    return 0


def drift(values: list[int]) -> dict[str, float]:
    """Say how memory changed between the second quarter of a soak and its last one."""
    quarter = len(values) // 4
    if not quarter:
        return {"first_mb": round(values[0] / 1024, 1), "last_mb": round(values[-1] / 1024, 1)}
    early, late = statistics.median(values[quarter : 2 * quarter]), statistics.median(values[-quarter:])
    return {
        "second_quarter_mb": round(early / 1024, 1),
        "last_quarter_mb": round(late / 1024, 1),
        "change_percent": round(100.0 * (late - early) / max(early, 1), 1),
    }


class Voyage:
    """A vehicle that sails circle after circle past a graph whose processes are killed, and what came of it.

    Parameters
    ----------
    given : argparse.Namespace
        The command line.
    """

    def __init__(self, given: argparse.Namespace) -> None:
        self.given = given
        self.rng = random.Random(given.seed)
        self.bags = Bags(given.bags)
        self.runs = [(scene, read_run(self.bags.path(scene))) for scene in Bags.SCENES[:3]]
        self.line: dict[str, Any] = {"kills": [], "faults": [], "circle_s": [], "grids": 0, "anew": 0}
        self.memory: dict[str, list[int]] = {}
        self.kills_left = given.kills if given.kills >= 0 else self.rng.randint(2, 6)
        self.circle = 0
        self.began = time.monotonic()

    def sail(self) -> dict[str, Any]:
        """Sail all circles; return what was seen."""
        with contextlib.ExitStack() as stack:
            self._start(stack)
            while self.circle < self.given.circles or time.monotonic() - self.began < self.given.seconds:
                if not self._sail_circle():
                    return self.line
                self._rest()
            self._finish()
        self.line |= {"circles": self.circle, "wall_s": round(time.monotonic() - self.began, 1)}
        if self.memory:
            self._tell_of_memory()
        return self.line

    def _start(self, stack: contextlib.ExitStack) -> None:
        """Start the graph, with all its nodes in the namespace, and the vehicle."""
        given = self.given
        domain = given.domain if given.domain >= 0 else stack.enter_context(DomainReservation())
        logs = given.folder / "log"
        graph_id = new_graph_id()
        self.server = stack.enter_context(start_fork_server(domain, logs, graph_id))
        recording = given.folder / "recording"
        plan = {**PLAN, "bag_recorder": {**PLAN["bag_recorder"], "out": str(recording)}}
        self.graph = Graph(plan, domain, logs, 1000, self.server, graph_id)
        for process in self.graph.processes.values():
            process._arguments = [*(process._arguments or ["--ros-args"]), "-r", f"__ns:={given.namespace}"]
        stack.enter_context(self.graph)
        self.vehicle = Vehicle(self.graph, domain, given.namespace)
        stack.callback(self.vehicle.close)
        # A circle takes 2 s here: the first would be over before a recorder that starts slowly is there.
        end = time.monotonic() + PATIENCE_S
        while not self.vehicle.heard >= PLAN.keys():
            self._look()
            if time.monotonic() > end:
                raise TimeoutError(f"never heard: {', '.join(sorted(PLAN.keys() - self.vehicle.heard))}")

    def _look(self) -> None:
        """Start again what died, and take what came."""
        self.graph.watch()
        self.vehicle.executor.spin_once(timeout_sec=0.05)
        self.line["anew"] += self.vehicle.begins_anew()

    def _sail_circle(self) -> bool:
        """Send a run, kill while it is worked on, and hold its grid against the bag's; False if it hung."""
        scene, bag = self.runs[(self.circle + self.given.first) % len(self.runs)]
        name, expected = self.vehicle.send(bag, self.circle * APART_NS), self.bags.live_hash(scene)
        since = time.monotonic()
        due = self._kills_due(since)
        while name not in self.vehicle.final:
            self._look()
            while due and time.monotonic() > due[0][0]:
                self._kill(due.pop(0)[1])
            if time.monotonic() - since > PATIENCE_S:
                self.line["faults"].append(
                    f"hung: circle {self.circle} is not at its end after {PATIENCE_S:g} s"
                )
                return False
        found, views = self.vehicle.final[name]
        if (found, views) != (expected, 36):
            self.line["faults"].append(
                f"the grid differs: circle {self.circle} of {scene}: {found}, {views} views"
            )
        self.line["grids"] += found == expected
        self.line["circle_s"].append(round(time.monotonic() - since, 1))
        if self.given.seconds:
            self._measure_memory()
        self.circle += 1
        with (self.given.folder / "circles.jsonl").open("a", encoding="utf-8") as file:
            told = {k: v if isinstance(v, int) else len(v) for k, v in self.line.items()}
            file.write(json.dumps(told) + "\n")
        return True

    def _kills_due(self, since: float) -> list[tuple[float, str]]:
        """Draw what is killed during a circle, and when."""
        given, rng = self.given, self.rng
        # In a graph that lives long, forked nodes alone are killed: without its server each takes long to
        # start.
        victims = [*PLAN, *([] if given.kills_a_circle else ["fork_server"])]
        share = (self.kills_left + 1) // 2 if self.circle + 1 < given.circles else self.kills_left
        count = rng.randint(1, given.kills_a_circle) if given.kills_a_circle else share
        span_s = 6.0 if self.circle else 9.0
        return sorted((since + rng.uniform(0.0, span_s), rng.choice(victims)) for _ in range(count))

    def _kill(self, victim: str) -> None:
        self.kills_left = max(self.kills_left - 1, 0)
        if victim != "fork_server":
            pid = self.graph.processes[victim].pid
        elif self.server is not None:
            pid = self.server.pid
        else:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            self.line["kills"].append((round(time.monotonic() - self.began, 2), victim))

    def _measure_memory(self) -> None:
        """Note what each process holds, and remove finished recordings: a soak would fill the disk."""
        for node, process in self.graph.processes.items():
            self.memory.setdefault(node, []).append(memory_kb(process.pid))
        if self.server is not None:
            self.memory.setdefault("fork_server", []).append(memory_kb(self.server.pid))
        with (self.given.folder / "memory.jsonl").open("a") as file:
            file.write(json.dumps({k: v[-1] for k, v in self.memory.items()}) + "\n")
        for old in self.given.folder.glob("recording*"):
            if (old / "metadata.yaml").exists():
                shutil.rmtree(old)

    def _rest(self) -> None:
        """Let time pass between two circles."""
        until = time.monotonic() + self.given.rest
        while time.monotonic() < until:
            self._look()

    def _finish(self) -> None:
        """End the graph once the recorder has every view; look for views that were lost or not recorded."""
        # What the recorder lacks yet is sent again before the source says that it has finished.
        end = time.monotonic() + 60.0
        while not self.given.seconds and time.monotonic() < end and not recorded(self.vehicle):
            self.graph.watch()
        if self.vehicle.lost:
            self.line["faults"].append(f"views lost: {self.vehicle.lost}")
        self.line["lost"] = sum(self.vehicle.lost.values())
        self.vehicle.executor.spin_once(timeout_sec=0.1)
        self.graph.stop()
        if self.given.seconds:
            return
        for folder in ("recording", *(f"recording_{n}" for n in range(2, self.circle + 1))):
            counts = read_run(self.given.folder / folder).counts
            if short := {s: counts.get(s, 0) for s in STREAMS if counts.get(s, 0) != 36}:
                self.line["faults"].append(f"{folder} lacks views: {short}")

    def _tell_of_memory(self) -> None:
        """Say how memory changed over the soak; growth of a twentieth is a fault."""
        line = self.line
        line["memory"] = {node: drift(values) for node, values in self.memory.items()}
        line["circle_s"] = line["circle_s"][:: max(len(line["circle_s"]) // 20, 1)]
        for node, told in line["memory"].items():
            if abs(told.get("change_percent", 0.0)) > 5.0:
                line["faults"].append(f"memory of {node} is not flat: {told}")


def recorded(vehicle: Vehicle) -> bool:
    """Spin a while; say whether the source has said to the running recorder that it has every view."""
    done: set[str] = set()
    beats: dict[tuple[str, str], Heartbeat] = {}

    def hear(msg: Any) -> None:
        item = progress_from_msg(msg)
        if isinstance(item, Heartbeat):
            done.update(item.values.get("finished_for", "").split())
            beats[item.node, item.values.get("input", "")] = item

    kind = MESSAGES.cls(TOPICS["progress"].type_name)
    subscription = vehicle.node.create_subscription(kind, "progress", hear, qos.REPORTS)
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        vehicle.executor.spin_once(timeout_sec=0.05)
    vehicle.node.destroy_subscription(subscription)
    mine = [b for (node, stream), b in beats.items() if node == "bag_recorder" and stream in STREAMS]
    return len(mine) == len(STREAMS) and all(b.instance in done for b in mine)


def main() -> int:
    """Print the line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bags", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--circles", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--kills", type=int, default=-1, help="-1: two to six")
    parser.add_argument("--kills-a-circle", type=int, default=0, help="one to so many, in every circle")
    parser.add_argument("--rest", type=float, default=0.0, help="seconds between circles")
    parser.add_argument("--first", type=int, default=0, help="contact to begin with")
    parser.add_argument("--domain", type=int, default=-1)
    parser.add_argument("--namespace", default="/csas")
    print(json.dumps(Voyage(parser.parse_args()).sail()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
