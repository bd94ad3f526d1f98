"""An outside classifier in ten lines: told of every view, however slow it is (docs/classifier.md)."""

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


rclpy.init()
node = create_node("classifier", namespace="csas")
with ViewSubscriber(node, "shadow", classify):
    spin(node)
