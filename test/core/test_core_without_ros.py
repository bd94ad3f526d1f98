"""The numerical core must work where no ROS is installed."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from pathlib import Path

import csas_shadow_ros.core

SCRIPT = """
import sys
for name in ("rclpy", "sensor_msgs", "nav_msgs", "geometry_msgs",
             "std_msgs", "visualization_msgs", "rosbags", "builtin_interfaces", "diagnostic_msgs"):
    sys.modules[name] = None
import importlib
for name in sys.argv[1:]:
    importlib.import_module(name)
loaded = [m for m in sys.modules if m.startswith(("msg_adapters", "csas_shadow_ros.nodes"))]
assert not loaded, loaded
print(len(sys.argv) - 1)
"""


def test_every_module_of_the_core_is_imported_without_ros():
    core = csas_shadow_ros.core
    names = [m.name for m in pkgutil.walk_packages(core.__path__, core.__name__ + ".")]
    assert len(names) >= 15
    root = str(Path(core.__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, core.__name__, *names],
        capture_output=True, text=True, timeout=120, cwd=root, env=_environment(root), check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == str(len(names) + 1)


def _environment(root):
    import os

    return {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
