"""Node `voxel_carver`: carves the voxel grid, and publishes it, its voxels and its mesh (section 4)."""

from __future__ import annotations

import math
import sys
import time
from typing import Any

from numpy.typing import NDArray
from rclpy.publisher import Publisher

from csas_shadow_ros.core.arcs import Arc, Arcs
from csas_shadow_ros.core.carving import Carver
from csas_shadow_ros.core.errors import NoTargetError, ParameterError
from csas_shadow_ros.core.geometry import looks_at
from csas_shadow_ros.core.mesh import Dimensions, measure, mesh_from_grid
from csas_shadow_ros.core.parameters import CarvingParameters
from csas_shadow_ros.core.segmentation import require_silhouette
from csas_shadow_ros.core.volume import Volume
from csas_shadow_ros.core.warm import warm_carving
from msg_adapters import Heartbeat, mesh_to_msg, view_from_msgs, voxel_grid_to_msgs, voxels_to_msg

from . import qos
from .base import INTEGRATED, CsasNode, Inlet, TargetInlet, run_node
from .growing import Growing
from .params import part


class VoxelCarverNode(CsasNode):
    """Takes `likelihood/*` (soft) or `shadow_mask/*` (hard); publishes `voxel_grid/*`, `voxels`, `mesh`."""

    name = "voxel_carver"

    def setup(self) -> None:
        """Make publishers, then the inlet of the method's stream."""
        p = self.parameters
        if p.target == "given" and not all(s > 0 for s in p.size_m):
            raise ParameterError(f"size_m is {list(p.size_m)}; expected x, y, z > 0 m with a given target")
        self.forget()
        self.grid_image = self.publisher("voxel_grid/image", qos.LATCHED)
        self.grid_info = self.publisher("voxel_grid/camera_info", qos.LATCHED)
        self.views_image = self.publisher("voxel_views/image", qos.LATCHED)
        self.views_info = self.publisher("voxel_views/camera_info", qos.LATCHED)
        self.voxels = self.publisher("voxels", qos.LATCHED)
        self.mesh = self.publisher("mesh", qos.LATCHED)
        self.stream = "shadow_mask" if p.takes_masks else "likelihood"
        self.target = TargetInlet(self, lambda: self.inlet.release(), self.begin_again)
        self.inlet = Inlet(self, self.stream, "sink", self.work, hold=self.target.missing)
        self.growing = Growing(self.publish_result, self.wanted, p.publish_hz)
        self.follow_sources()
        # More often than a node's own tick: a sector's last view is to be shown at once.
        self.every(0.02, self.show)

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_carving()

    def forget(self) -> None:
        """Drop the grid."""
        self.carver: Carver | None = None
        self.object_voxels = 0
        self.arcs = Arcs()
        self.dimensions: Dimensions | None = None

    def begin_again(self) -> None:
        """Drop the grid of a target that has moved."""
        self.forget()
        self.growing.changed()

    def waiting(self) -> str:
        """Say so if views wait for the target."""
        return self.target.missing() if self.inlet.held else ""

    def state_counts(self) -> dict[str, int]:
        """Return how many views the grid holds, and whether that is all."""
        held = len(self.carver.stamps) if self.carver else 0
        complete = hasattr(self, "growing") and self.growing.complete
        arc = round(math.degrees(self.arcs.covered_rad))
        return {"views": held, "complete": int(complete), "arc_deg": arc}

    def state_values(self) -> dict[str, str]:
        """Return how large the object is as far as it has been seen."""
        d = self.dimensions
        if d is None:
            return {}
        return {name: f"{getattr(d, name):.3f}" for name in ("length_m", "width_m", "height_m")}

    def work(self, image: Any, info: Any) -> str | None:
        """Integrate one view; one that is in already changes nothing."""
        view = view_from_msgs(image, info, self.stream)
        target = self.target.target
        if target is None:
            raise NoTargetError("no target: topic target says that there is no object in the scene")
        if self.target.may_move and not looks_at(view.info, target.position_m):
            return None  # of the target before; the view of this one is on its way
        if self.carver is None:
            p = part(self.parameters, CarvingParameters)
            self.carver = Carver(Volume.around(target.position_m, target.size_m, p.voxel_size_m), p)
        if self.carver.integrate(require_silhouette(view) if self.stream == "shadow_mask" else view):
            half = view.info.aperture_rad / 2.0
            self.arcs.add(Arc(view.info.aspect_rad - half, 2.0 * half))
            self.growing.changed()
        return INTEGRATED

    def on_source(self, beat: Heartbeat) -> None:
        """Finish once a source says that every view is here."""
        if beat.values.get("stream") != "sector":
            self.growing.source_says(self.inlet.instance in beat.values.get("finished_for", "").split())

    def show(self) -> None:
        """Publish what has changed."""
        if not self.active:
            return
        before = self.growing.complete
        self.growing.period_s = 1.0 / self.parameters.publish_hz
        self.growing.tick(time.monotonic())
        if self.growing.complete and not before:
            self.tell_now()
            views = len(self.carver.stamps) if self.carver else 0
            found = f"an object of {self.object_voxels} voxels" if self.object_voxels else "no object"
            self.get_logger().info(f"complete: {views} views, {found}; the result is published")

    def wanted(self) -> bool:
        """Say whether anybody looks at unfinished results."""
        return looked_at(self.grid_image, self.voxels, self.mesh)

    def publish_result(self) -> None:
        """Publish grid, voxels and mesh as they are; an unfinished one to those who look alone."""
        if self.carver is None:
            # Nothing came: no object as far as anybody knows.
            self.mesh.publish(mesh_to_msg(self.messages, None, self.now_ns()))
            return
        # Until all views are here the first look does: the second goes through all the silhouettes again.
        final = self.growing.final
        grid = self.carver.grid() if final else self.carver.first_look()
        if final and grid.seabed is not None and grid.seabed.believed:
            self.get_logger().info(
                f"the seabed slopes by {math.degrees(grid.seabed.slope_rad):.1f}° against the track's level:"
                " the sonar's heights were corrected"
            )
        stamp = max(self.carver.stamps)
        self.object_voxels = int(grid.occupied.sum())
        pairs: dict[str, tuple[Publisher, Publisher, NDArray[Any]]] = {
            "voxel_grid": (self.grid_info, self.grid_image, grid.likelihood),
            "voxel_views": (self.views_info, self.views_image, grid.views),
        }
        for name, (info_publisher, image_publisher, values) in pairs.items():
            if final or looked_at(info_publisher, image_publisher):
                image, info = voxel_grid_to_msgs(self.messages, grid.volume, values, stamp, name)
                info_publisher.publish(info)
                image_publisher.publish(image)
        if final or looked_at(self.voxels):
            self.voxels.publish(voxels_to_msg(self.messages, grid, stamp))
        mesh = mesh_from_grid(grid) if grid.occupied.any() else None
        self.dimensions = measure(mesh) if mesh is not None else None
        # A mesh of ten thousand triangles takes longer to write as a message than to carve from a view.
        if final or looked_at(self.mesh):
            self.mesh.publish(mesh_to_msg(self.messages, mesh, stamp))


def looked_at(*publishers: Publisher) -> bool:
    """Say whether anybody subscribes to one of the topics."""
    return any(publisher.get_subscription_count() for publisher in publishers)


def main() -> int:
    """Run the node."""
    return run_node(VoxelCarverNode)


if __name__ == "__main__":
    sys.exit(main())
