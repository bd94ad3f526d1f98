"""A replay as a test of launch_testing: `launch_test replay_launch_test.py`, or add_launch_test in CMake.

The replay fails where its results are not as expect.yaml says.
"""

import os
import sys
import unittest
from pathlib import Path

import launch_testing
import launch_testing.actions
import launch_testing.asserts
import launch_testing.util
from launch.actions import ExecuteProcess

from launch import LaunchDescription

HERE = Path(__file__).resolve().parent
BAG = os.environ.get("BAG", str(HERE.parents[1] / "bags" / "demo"))
RESULTS = os.environ.get("RESULTS", "results/launch_test")


def generate_test_description():
    """Describe the replay."""
    command = [sys.executable, "-m", "csas_shadow_ros", "replay", BAG, "--out", RESULTS, "--overwrite"]
    replay = ExecuteProcess(cmd=[*command, "--expect", str(HERE / "expect.yaml")], output="screen")
    # The replay ends before its tests do.
    keep_alive = launch_testing.util.KeepAliveProc()
    description = LaunchDescription([replay, keep_alive, launch_testing.actions.ReadyToTest()])
    return description, {"replay": replay}


class RunsToItsEnd(unittest.TestCase):
    """While the replay runs."""

    def test_it_comes_to_its_end(self, proc_info, replay):
        """A replay of a circle takes half a minute; machines of CI take their time."""
        proc_info.assertWaitForShutdown(process=replay, timeout=600.0)


@launch_testing.post_shutdown_test()
class IsAsExpected(unittest.TestCase):
    """After it."""

    def test_it_ended_well(self, proc_info, replay):
        """Exit status 4: the results are not as expected; a line of its output says in what."""
        launch_testing.asserts.assertExitCodes(proc_info, process=replay)
