"""Compiled kernels are kept where it can be written, and missing places are no errors."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

#: Calls one kernel, and tells where it is kept and whether it was compiled. `patch` stands for a file system.
PROGRAM = """
import json, tempfile
{patch}
from csas_shadow_ros.core import kernels
import numpy as np
from csas_shadow_ros.core.imaging.composites import _power_of_parts as one
out = np.empty((2, 2), np.float32)
one(np.ones((2, 4), np.float32), out)
assert (out == 2.0).all()
place = kernels.place()
counts = [sum(c.values()) for c in (one.stats.cache_hits, one.stats.cache_misses)]
print(json.dumps([place.kind, place.folder and str(place.folder), *counts]))
"""
#: A package that can be read and not written, whoever runs this: the superuser writes where he likes.
READ_ONLY = """
from csas_shadow_ros.core import kernels
usable = kernels._usable
kernels._usable = lambda place: place.kind != "package" and usable(place)
"""
NO_TEMPORARY = "tempfile.tempdir = '/dev/null/none'"


@dataclass
class Said:
    """What the program told."""

    kind: str
    folder: str | None
    loaded: int
    compiled: int
    notices: list[str]


class Machine:
    """A copy of the package that nobody has compiled, and folders that can be written or not."""

    def __init__(self, root: Path) -> None:
        self.site, self.cache, self.temporary = root / "site", root / "home" / ".cache", root / "tmp"
        self.temporary.mkdir()
        hidden = shutil.ignore_patterns("__pycache__")
        self.package = self.site / "csas_shadow_ros"
        shutil.copytree(ROOT / "csas_shadow_ros", self.package, ignore=hidden)

    def run(self, patch: str = "", *, home: bool = True, **environment: str) -> Said:
        """Run the program."""
        given = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        given.update(PYTHONPATH=str(self.site), TMPDIR=str(self.temporary), PYTHONDONTWRITEBYTECODE="1")
        given["HOME"] = str(self.cache.parent) if home else "/dev/null"
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(patch=patch)],
            capture_output=True,
            text=True,
            check=False,
            env={**given, **environment},
            cwd=self.site,
        )
        assert done.returncode == 0, done.stderr
        return Said(*json.loads(done.stdout), notices=done.stderr.splitlines())

    def block_package(self) -> None:
        """Put a file where the package's cache would be made: not even the superuser makes a folder there."""
        (self.package / "__pycache__").write_text("")
        (self.package / "core" / "__pycache__").write_text("")


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_kernels_are_kept_in_the_package_without_a_word(machine: Machine) -> None:
    first, second = machine.run(), machine.run()
    assert (first.kind, first.compiled, second.loaded, second.compiled) == ("package", 1, 1, 0)
    assert Path(first.folder or "").is_relative_to(machine.package)
    assert first.notices == second.notices == []
    assert not machine.cache.exists()


def test_a_package_that_cannot_be_written_leaves_the_users_cache_and_says_so_once(machine: Machine) -> None:
    machine.block_package()
    first, second = machine.run(), machine.run()
    assert (first.kind, first.compiled, second.loaded, second.compiled) == ("user cache", 1, 1, 0)
    assert len(first.notices) == 1
    assert str(machine.cache) in first.notices[0]
    assert second.notices == []


def test_without_a_home_the_temporary_folder_serves_its_owner_alone(machine: Machine) -> None:
    machine.block_package()
    first, second = machine.run(home=False), machine.run(home=False)
    assert (first.kind, first.compiled, second.loaded) == ("temporary folder", 1, 1)
    folder = Path(first.folder or "")
    assert folder.parent == machine.temporary
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(first.notices) == 1
    assert second.notices == []
    # Others could have put there what would be executed.
    folder.chmod(0o777)
    refused = machine.run(home=False)
    assert refused.kind == "nowhere"


def test_where_nothing_can_be_written_the_core_still_works(machine: Machine) -> None:
    machine.block_package()
    said = machine.run(NO_TEMPORARY, home=False)
    assert (said.kind, said.folder) == ("nowhere", None)
    assert len(said.notices) == 1
    assert "NUMBA_CACHE_DIR" in said.notices[0]


def test_what_was_compiled_into_a_read_only_package_is_used(machine: Machine) -> None:
    assert machine.run().compiled == 1
    said = machine.run(READ_ONLY)
    assert (said.kind, said.loaded, said.compiled) == ("user cache", 1, 0)
    # A service user has no home either.
    said = machine.run(READ_ONLY, home=False)
    assert (said.kind, said.loaded, said.compiled) == ("temporary folder", 1, 0)


def test_numbas_own_variable_goes_first(machine: Machine, tmp_path: Path) -> None:
    said = machine.run(NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert (said.kind, said.folder) == ("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    assert list((tmp_path / "mine").rglob("*.nbi"))
