"""An outside classifier in a few lines: told of every view, however slow it is (docs/classifier.md)."""

import math
import sys
import time

import numpy as np
import rclpy

from csas_shadow_ros.client import ViewSubscriber, create_node, spin

SECONDS_A_VIEW = float(sys.argv[1]) if len(sys.argv) > 1 else 0.0


def classify(pixels, info):
    """Say how much of a view is dark."""
    time.sleep(SECONDS_A_VIEW)  # what a network would take
    dark = np.mean(pixels[np.isfinite(pixels)] < 0.3 * np.nanmedian(pixels))
    print(f"{info.stamp_ns} {math.degrees(info.aspect_rad):6.1f}° {dark:4.0%} dark", flush=True)


def finished(run_ns):
    """Say that every view of a run has been classified: the place for the verdict on the contact."""
    print(f"the run of {run_ns} ns is over", flush=True)


rclpy.init()
node = create_node("classifier", namespace="csas")
with ViewSubscriber(node, "shadow", classify, on_finished=finished):
    spin(node)
