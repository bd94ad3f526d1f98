"""Node `shadow_enhancement`: focuses the shadows of every sub-aperture view (section 3.2)."""

from __future__ import annotations

import sys
from typing import Any

from csas_shadow_ros.core.errors import NoTargetError
from csas_shadow_ros.core.imaging.display import decibel_picture
from csas_shadow_ros.core.parameters import PipelineParameters, ShadowParameters
from csas_shadow_ros.core.pipeline import ProcessedView
from csas_shadow_ros.core.warm import warm_enhancement
from msg_adapters import display_to_msg, view_from_msgs

from . import qos
from .runtime.base import PUBLISHED, CsasNode, Inlet, TargetInlet, ViewOutlet, run_node
from .runtime.params import part


class ShadowEnhancementNode(CsasNode):
    """Takes `sub_aperture/*`, publishes `shadow/*`, and pictures on `shadow/display` if subscribed."""

    name = "shadow_enhancement"

    def setup(self) -> None:
        """Make the outlet before the inlet, so that input can go out."""
        self.pipeline = PipelineParameters(shadow=part(self.parameters, ShadowParameters))
        self.shadow = ViewOutlet(self, "shadow")
        self.display = self.publisher("shadow/display", qos.VIEWS)
        self.target = TargetInlet(self, lambda: self.inlet.release())
        self.inlet = Inlet(self, "sub_aperture", "stage", self.work, hold=self.target.hold)

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_enhancement()

    def waiting(self) -> str:
        """Say if views wait for the target."""
        return self.target.missing() if self.inlet.held else ""

    def work(self, image: Any, info: Any) -> str:
        """Enhance one view."""
        view = view_from_msgs(image, info, "sub_aperture")
        if self.target.target is None:
            raise NoTargetError("no target: topic target says that there is no object in the scene")
        self.target.decision.require_frame(view.info)
        made = ProcessedView(self.target.target, self.pipeline, sub_aperture=view)
        shadow = made.require("shadow")
        self.shadow.send(shadow)
        if self.display.get_subscription_count():
            picture = decibel_picture(shadow.pixels)
            messages = self.messages.in_frame(shadow.info.frame)
            self.display.publish(display_to_msg(messages, picture, shadow.info.stamp_ns))
        return PUBLISHED


def main() -> int:
    """Run the node."""
    return run_node(ShadowEnhancementNode)


if __name__ == "__main__":
    sys.exit(main())
