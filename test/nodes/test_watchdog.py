"""A node that stands still within the middleware ends itself: the call keeps the interpreter's lock."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time

import pytest

pytest.importorskip("rclpy")

from csas_shadow_ros.nodes.runtime.watchdog import says_that_it_stood_still

#: As rclpy's publish does while the middleware waits: nothing else of Python runs until it returns.
KEEPS_THE_INTERPRETER = "ctypes.PyDLL(None).sleep(60)"


def ended(script: str, domain: int = 0) -> tuple[int, str, float]:
    """Run a script; return its status, what it said, and how long it took (s)."""
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stderr=subprocess.PIPE,
        text=True,
        timeout=50,
        check=False,
    )
    return done.returncode, done.stderr, time.monotonic() - began


def test_a_process_whose_interpreter_stands_still_ends_with_its_stacks_in_the_log() -> None:
    code, said, _ = ended(f"""
        import ctypes
        from csas_shadow_ros.nodes.runtime.watchdog import ends_if_it_stands_still
        def publish():
            {KEEPS_THE_INTERPRETER}
        with ends_if_it_stands_still(2.0):
            publish()
    """)
    assert code == 1
    assert "in publish" in said
    assert says_that_it_stood_still(said)
    assert says_that_it_stood_still(f"[INFO] active\n{said.strip()}")
    assert not says_that_it_stood_still(f"{said}[INFO] active: its successor\n")
    assert not says_that_it_stood_still("[ERROR] Timeout (of something else)")


def test_a_node_that_stands_still_at_its_start_ends(domain: int) -> None:
    code, said, _ = ended(
        f"""
        import ctypes, functools, sys
        from csas_shadow_ros.nodes.runtime import base
        from csas_shadow_ros.nodes.composites import CompositesNode
        base.ends_if_it_stands_still = functools.partial(base.ends_if_it_stands_still, 2.0)
        class Stuck(CompositesNode):
            def start(self):
                {KEEPS_THE_INTERPRETER}
        sys.exit(base.run_node(Stuck, []))
        """,
        domain,
    )
    assert code == 1
    assert "in start" in said


def test_work_that_lasts_longer_ends_nothing() -> None:
    code, said, took_s = ended("""
        import time
        from csas_shadow_ros.nodes.runtime.watchdog import ends_if_it_stands_still
        with ends_if_it_stands_still(1.0):
            end = time.monotonic() + 3.0
            while time.monotonic() < end:
                sum(range(10000))
        time.sleep(2.0)  # and afterwards nothing watches any more
    """)
    assert (code, said) == (0, "")
    assert took_s > 5.0


def test_a_standard_error_without_a_descriptor_costs_the_watch_alone() -> None:
    code, said, _ = ended("""
        import io, sys
        from csas_shadow_ros.nodes.runtime.watchdog import ends_if_it_stands_still
        kept, sys.stderr = sys.stderr, io.StringIO()
        with ends_if_it_stands_still(1.0):
            pass
        sys.stderr = kept
    """)
    assert (code, said) == (0, "")
