"""Node `shadow_likelihood`: likelihood of lying outside the shadow, and the silhouette (section 4)."""

from __future__ import annotations

import sys
from typing import Any

from csas_shadow_ros.core.parameters import LikelihoodParameters, PipelineParameters
from csas_shadow_ros.core.pipeline import ProcessedView
from csas_shadow_ros.core.warm import warm_likelihood
from msg_adapters import view_from_msgs

from .runtime.base import PUBLISHED, CsasNode, Inlet, TargetInlet, ViewOutlet, run_node
from .runtime.params import part


class ShadowLikelihoodNode(CsasNode):
    """Takes `shadow/*`, publishes `likelihood/*`, and `shadow_mask/*` once there is a target.

    The likelihood needs no target. The mask does, so its publisher exists only from when the target
    is known: a recorder does not wait for masks that nobody can make.
    """

    name = "shadow_likelihood"

    def setup(self) -> None:
        """Make the outlets before the inlet."""
        self.pipeline = PipelineParameters(likelihood=part(self.parameters, LikelihoodParameters))
        self.likelihood = ViewOutlet(self, "likelihood")
        self.mask: ViewOutlet | None = None
        self.target = TargetInlet(self, self._open_mask)
        if self.target.known:
            self._open_mask()
        self.inlet = Inlet(self, "shadow", "stage", self.work)

    def _open_mask(self) -> None:
        if self.target.target is not None and self.mask is None:
            self.mask = ViewOutlet(self, "shadow_mask")

    @classmethod
    def preload(cls) -> None:
        """Load the kernels."""
        warm_likelihood()

    def forget(self) -> None:
        """Drop the mask's publisher."""
        self.mask = None

    def waiting(self) -> str:
        """Say if no masks can be made."""
        missing = self.target.missing()
        return f"{missing}; likelihood only, no masks" if missing and self.counts["in"] else ""

    def work(self, image: Any, info: Any) -> str:
        """Make the likelihood, and the mask, of one view."""
        view = view_from_msgs(image, info, "shadow")
        self.target.decision.require_frame(view.info)
        made = ProcessedView(self.target.target, self.pipeline, shadow=view)
        made.require("levels")  # a view without levels is refused, whoever takes what is made of it
        # The mask goes first: once the likelihood is in the grid the view may count as done.
        if self.mask is not None and self.mask.wanted and self.target.target is not None:
            self.mask.send(made.require("mask"))
        if self.likelihood.wanted:
            self.likelihood.send(made.require("likelihood"))
        return PUBLISHED


def main() -> int:
    """Run the node."""
    return run_node(ShadowLikelihoodNode)


if __name__ == "__main__":
    sys.exit(main())
