"""The locked files hold everything that setup.py asks for, each with hashes, and pip takes them."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from test_platforms import PYTHONS, assigned, no_index

ROOT = Path(__file__).resolve().parent.parent
#: What each file is for: lists of setup.py.
FILES = {
    "locked.txt": ("CORE",),
    "locked-all.txt": ("CORE", "ROS", "XARRAY", "ARCHIVE", "CLUSTER", "MAPS", "IMPORT", "SECURITY"),
}
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")


def locked(name: str) -> list[tuple[Requirement, list[str]]]:
    """Return what a file pins, each with its hashes."""
    lines = (ROOT / "constraints" / name).read_text().replace("\\\n", " ").splitlines()
    found = []
    for line in lines:
        if line and not line.startswith("#"):
            text, *hashes = re.split(r"\s+(?=--hash)", line.strip())
            found.append((Requirement(text), hashes))
    return found


def build_requirements() -> list[str]:
    text = (ROOT / "pyproject.toml").read_text()
    return list(ast.literal_eval(text.split("[build-system]\nrequires = ", 1)[1].splitlines()[0]))


def there(machine: str, python: str) -> dict[str, str]:
    return {
        **{key: str(value) for key, value in default_environment().items()},
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "python_version": python,
        "python_full_version": f"{python}.0",
    }


@pytest.mark.parametrize("name", FILES)
def test_every_line_pins_one_version_with_hashes(name: str) -> None:
    lines = locked(name)
    assert len(lines) > 40
    for requirement, hashes in lines:
        assert [s.operator for s in requirement.specifier] == ["=="], requirement
        assert hashes, f"{requirement} has no hash"
        assert all(HASH.fullmatch(one) for one in hashes), requirement


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
@pytest.mark.parametrize("name", FILES)
def test_what_setup_py_asks_for_is_locked_at_a_version_that_it_takes(
    name: str, machine: str, python: str
) -> None:
    """Add a dependency, and `make lock`."""
    here = there(machine, python)
    pins: dict[str, str] = {}
    for requirement, _ in locked(name):
        if requirement.marker is None or requirement.marker.evaluate(here):
            key = canonicalize_name(requirement.name)
            assert key not in pins, f"{key} is locked twice"
            pins[key] = next(iter(requirement.specifier)).version
    asked = [*build_requirements(), *(text for part in FILES[name] for text in assigned(part))]
    for needed in map(Requirement, asked):
        if needed.marker is None or needed.marker.evaluate(here):
            version = pins.get(canonicalize_name(needed.name))
            assert version is not None, f"{needed} is not locked"
            assert needed.specifier.contains(version), f"{needed} is locked at {version}"


def test_the_files_are_made_for_the_extras_that_the_makefile_names() -> None:
    text = (ROOT / "Makefile").read_text()
    extras = re.search(r"^LOCK_EXTRAS := (.+)$", text, re.MULTILINE)
    assert extras is not None
    assert tuple(word.upper() for word in extras[1].split()) == FILES["locked-all.txt"][1:]
    # What is there for tests and development alone has no place on a vehicle.
    setup = (ROOT / "setup.py").read_text()
    declared = set(
        re.findall(r'^        "(\w+)": ', setup.split("extras_require={", 1)[1].split("}")[0], re.MULTILINE)
    )
    assert declared - set(extras[1].split()) == {"test", "bench", "build", "dev", "docs"}


@pytest.mark.long
@pytest.mark.parametrize("name", FILES)
def test_pip_takes_the_files_and_needs_nothing_besides(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet"]
    command += ["--disable-pip-version-check", "--require-hashes", "--target", str(tmp_path)]
    command += ["--requirement", str(ROOT / "constraints" / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and no_index(done.stderr, tmp_path):
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr
