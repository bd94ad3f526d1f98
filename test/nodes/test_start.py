"""Starting nodes: what a signal before the start and arguments that cannot be read lead to."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from csas_shadow_ros.nodes.runtime import start
from csas_shadow_ros.nodes.runtime.params import NODES

ROOT = Path(__file__).resolve().parents[2]

# A library that swallows KeyboardInterrupt while it is imported, as trimesh does.
INTERRUPTED_IMPORT = """
import importlib, os, signal, sys, types
from csas_shadow_ros.nodes.runtime import start

def swallow(name):
    try:
        os.kill(os.getpid(), getattr(signal, sys.argv[1]))
        sum(range(1000))
    except BaseException:
        pass
    return types.SimpleNamespace(main=lambda: 77)

importlib.import_module = swallow
sys.exit(start.voxel_carver())
"""


def run(*arguments):
    """Run Python on the tree."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
def test_a_signal_during_the_imports_ends_a_node_at_once_and_silently(signal):
    done = run("-c", INTERRUPTED_IMPORT, signal)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("node", NODES)
def test_every_node_has_an_entry_point_that_runs_its_module(node, monkeypatch):
    imported = []

    class Module:
        @staticmethod
        def main():
            return 5

    monkeypatch.setattr(start.importlib, "import_module", lambda name: imported.append(name) or Module)
    monkeypatch.setattr(start.signal, "signal", lambda *_: None)
    assert getattr(start, node)() == 5
    assert imported == [f"csas_shadow_ros.nodes.{node}"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("-p", "foo"), "-p foo"),
        (("--params-file", "/nowhere/parameters.yaml"), "/nowhere/parameters.yaml"),
        (("--bogus",), "--bogus"),
    ],
)
def test_ros_arguments_that_cannot_be_read_are_refused_without_a_traceback(arguments, named):
    done = run("-m", "csas_shadow_ros.nodes.composites", "--ros-args", *arguments)
    assert done.returncode == 2
    own = [line for line in done.stderr.splitlines() if line.startswith("composites: ")]
    assert len(own) == 1
    assert named in own[0]
    assert "Traceback" not in done.stderr
