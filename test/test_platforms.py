"""Where the package installs: Ubuntu 24.04 beside ROS 2 Jazzy, ARM64, every Python that it declares."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
#: rosdep keys on Ubuntu 24.04: name on PyPI, name of the module, apt's version (packages.ubuntu.com).
NOBLE = {
    "python3-numpy": ("numpy", "numpy", "1.26.4"),
    "python3-scipy": ("scipy", "scipy", "1.11.4"),
    "python3-skimage": ("scikit-image", "skimage", "0.22.0"),
    "python3-opencv": ("opencv-python-headless", "cv2", "4.6.0"),
    "python3-matplotlib": ("matplotlib", "matplotlib", "3.6.3"),
    "python3-aiohttp": ("aiohttp", "aiohttp", "3.9.1"),
    "python3-cryptography": ("cryptography", "cryptography", "41.0.7"),
    "python3-numba": ("numba", "numba", "0.58.1"),
    "python3-yaml": ("PyYAML", "yaml", "6.0.1"),
    "python3-tqdm": ("tqdm", "tqdm", "4.66.2"),
    "python3-pil": ("pillow", "PIL", "10.2.0"),
    "python3-pytest": ("pytest", "pytest", "7.4.4"),
    "python3-hypothesis": ("hypothesis", "hypothesis", "6.98.15"),
}
#: Keys that rosdep hands to pip, which brings the newest.
BY_PIP = {"python3-trimesh-pip": ("trimesh", "trimesh"), "python3-rosbags-pip": ("rosbags", "rosbags")}
ROS = re.compile(
    r"rclpy|launch|launch_ros|ament_index_python|tf2_ros|rcl_interfaces|\w+_(msgs|srvs)|builtin_interfaces"
)


def assigned(name: str) -> list[str]:
    """Read a list of setup.py, and what is added to it, without running it."""
    found: list[str] = []
    for statement in ast.parse((ROOT / "setup.py").read_text()).body:
        targets = getattr(statement, "targets", [getattr(statement, "target", None)])
        if any(getattr(target, "id", "") == name for target in targets):
            value = statement.value
            found += assigned(value.id) if isinstance(value, ast.Name) else ast.literal_eval(value)
    return found


def requirements(name: str) -> dict[str, Requirement]:
    return {canonicalize_name(r.name): r for r in map(Requirement, assigned(name))}


CORE, TEST = requirements("CORE"), requirements("TEST")


def imported() -> set[str]:
    """Return the outermost names of what the package and its launch files import."""
    names: set[str] = set()
    for folder in ("csas_shadow_ros", "msg_adapters", "launch"):
        for file in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Import):
                    names |= {a.name.split(".")[0] for a in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    names.add(node.module.split(".")[0])
    return names


def declared() -> set[str]:
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    return {e.text or "" for e in root if e.tag in ("exec_depend", "test_depend", "depend")}


@pytest.mark.parametrize("key", NOBLE)
def test_what_apt_has_on_ubuntu_24_04_is_new_enough(key: str) -> None:
    name, _, version = NOBLE[key]
    requirement = {**TEST, **CORE}[canonicalize_name(name)]
    assert requirement.specifier.contains(version), f"{requirement} refuses {key} {version}"


def test_every_library_that_has_a_rosdep_key_is_in_package_xml() -> None:
    keys = {key: module for key, (_, module, _) in NOBLE.items()} | {k: m for k, (_, m) in BY_PIP.items()}
    used = imported() | {"pytest", "hypothesis"}
    assert {key for key, module in keys.items() if module in used} <= declared()


def test_every_ros_package_that_is_imported_is_in_package_xml() -> None:
    used = {name for name in imported() if ROS.fullmatch(name)} - {"csas_shadow_ros"}
    assert {"rcl_interfaces", "launch", "launch_ros", "rclpy"} <= used
    assert used <= declared()


def test_the_constraints_of_noble_fit_what_is_required_and_what_apt_has() -> None:
    lines = (ROOT / "constraints" / "noble.txt").read_text().splitlines()
    given = {canonicalize_name(r.name): r for r in map(Requirement, (x for x in lines if x and x[0] != "#"))}
    apt = {canonicalize_name(name): version for name, _, version in NOBLE.values()}
    # matplotlib of that time warns beside a newer pyparsing, and a warning fails the tests.
    assert set(given) <= {*CORE, "pyparsing"}
    # numpy's is the one that rclpy was built for, and numba's goes with it.
    assert {"numpy", "numba", "scipy", "opencv-python-headless", "matplotlib"} <= set(given)
    for name, constraint in given.items():
        if name in apt and name != "opencv-python-headless":  # the wheel's version has a fourth number
            assert constraint.specifier.contains(apt[name]), f"{constraint} is not apt's {apt[name]}"
        for pinned in (s.version for s in constraint.specifier if s.operator == "=="):
            if name in CORE:
                assert CORE[name].specifier.contains(pinned), f"{constraint} is refused by {CORE[name]}"


def test_no_figure_asks_for_a_legend_that_matplotlib_3_6_cannot_place() -> None:
    files = list((ROOT / "csas_shadow_ros").rglob("*.py"))
    assert len(files) > 50
    assert [f.name for f in files if 'loc="outside' in f.read_text()] == []


def test_no_python_is_declared_that_is_not_allowed_and_none_is_left_out() -> None:
    text = (ROOT / "setup.py").read_text()
    assert 'python_requires=">=3.10,<3.14"' in text
    assert "range(10, 14)" in text


def required_on(machine: str, python: str) -> list[str]:
    """Return CORE as pip would read it there: pip itself judges markers by the machine that it runs on."""
    there = default_environment() | {
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "python_version": python,
        "python_full_version": f"{python}.0",
    }
    chosen = [r for r in CORE.values() if r.marker is None or r.marker.evaluate(there)]
    return [f"{r.name}{r.specifier}" for r in chosen]


def test_embree_is_asked_for_where_it_has_a_wheel() -> None:
    def asked(machine: str) -> bool:
        return any(r.startswith("embreex") for r in required_on(machine, "3.12"))

    assert asked("x86_64")
    assert not asked("aarch64")


def no_index(stderr: str, folder: Path) -> bool:
    """Say whether pip failed for want of a package index, and not for what it was asked for."""
    if not re.search(r"Failed to establish|NewConnectionError|timed out|from versions: none", stderr):
        return False
    # Without an index nothing is found; with one, what is found has versions.
    probe = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--timeout", "10"]
    probe += ["--retries", "0", "--dest", str(folder), "packaging"]
    return bool(subprocess.run(probe, capture_output=True, check=False).returncode)


# Half a minute each.
@pytest.mark.parametrize("python", [pytest.param(PYTHONS[0], marks=pytest.mark.long), PYTHONS[-1]])
def test_every_core_dependency_has_a_wheel_for_arm64(python: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet"]
    command += ["--disable-pip-version-check", "--only-binary=:all:", "--target", str(tmp_path)]
    for platform in ("manylinux_2_28", "manylinux_2_27", "manylinux_2_26", "manylinux_2_17", "manylinux2014"):
        command += ["--platform", f"{platform}_aarch64"]
    command += [
        "--python-version",
        python,
        "--timeout",
        "10",
        "--retries",
        "1",
        *required_on("aarch64", python),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and no_index(done.stderr, tmp_path):
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr
