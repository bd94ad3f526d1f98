"""A graph of nodes in this process, on a domain of its own."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from typing import Any

# Before rclpy makes its first context: nothing leaves this machine, and logs go to a place of their own.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="csas_test_log_"))

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.graph.processes import DomainReservation
from csas_shadow_ros.nodes.runtime.base import CsasNode

#: 36 views and few voxels: the same code as for a large run, in a second.
STEP_DEG, VOXEL_M = 10.0, 0.05
PARAMETERS = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=STEP_DEG), carving=CarvingParameters(voxel_size_m=VOXEL_M)
)


class Graph:
    """Nodes that share one executor; what a test spins."""

    def __init__(self) -> None:
        self._domain = DomainReservation()
        self.domain_id = self._domain.domain_id
        self.context = Context()
        rclpy.init(context=self.context, domain_id=self.domain_id)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes: list[CsasNode] = []
        self.plain: list[Any] = []

    def add(self, kind: type[CsasNode], **overrides: Any) -> Any:
        """Start a node."""
        node = kind(context=self.context, overrides=overrides)
        self.nodes.append(node)
        assert node.start(), node.error
        self.executor.add_node(node)
        return node

    def plain_node(self, name: str) -> Any:
        """Make an ordinary rclpy node, as somebody else's would be."""
        node = rclpy.create_node(name, context=self.context, namespace="csas")
        self.plain.append(node)
        self.executor.add_node(node)
        return node

    def spin_until(self, condition: Callable[[], bool], timeout_s: float = 30.0, what: str = "") -> None:
        """Spin until something holds; fail after the timeout."""
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, f"not within {timeout_s} s: {what or condition}\n{self.state()}"
            self.executor.spin_once(timeout_sec=0.05)

    def kill(self, node: CsasNode) -> None:
        """End a node as SIGKILL does: at once, without a goodbye, with all that it holds."""
        node._beat_stop.set()
        with node._beat_lock:
            node.active = False
        self.executor.remove_node(node)
        self.nodes.remove(node)
        node._destroy_owned()
        node.destroy_node()

    def state(self) -> str:
        """Say how far each node is."""
        return "\n".join(
            f"{n.name}: {dict(n.counts)} {dict(n.reasons)} {n.state_counts()} {n.waiting()} {n.error}"
            f" {[s.counts() for s in n.sources]}"
            for n in self.nodes
        )

    def close(self) -> None:
        """End everything."""
        for node in self.nodes:
            self.executor.remove_node(node)
            node.stop()
            node.destroy_node()
        for node in self.plain:
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown(timeout_sec=1.0)
        rclpy.shutdown(context=self.context)
        self._domain.close()
