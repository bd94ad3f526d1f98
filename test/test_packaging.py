"""Packaging: colcon, pip and ros2 run agree on names, versions and what is installed."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import pytest
import yaml

import csas_shadow_ros
from csas_shadow_ros.node_table import NODES

ROOT = Path(__file__).resolve().parent.parent


def nodes():
    return tuple(NODES)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    """The wheel that pip would install, built from a copy of what it needs."""
    import shutil

    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("csas_shadow_ros", "msg_adapters", "resource", "config", "launch"):
        if (ROOT / name).exists():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    done = subprocess.run(
        [*command, "--no-index", "--wheel-dir", out, source], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (path,) = out.glob("*.whl")
    return zipfile.ZipFile(path)


def test_the_changelog_and_the_citation_are_of_this_version():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changelog, re.MULTILINE)[1] == csas_shadow_ros.__version__
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == csas_shadow_ros.__version__


def test_package_xml_and_the_package_agree_on_name_version_and_licence():
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    assert root.get("format") == "3"
    assert root.findtext("name") == "csas_shadow_ros"
    assert root.findtext("version") == csas_shadow_ros.__version__
    assert root.findtext("license") == "MIT"
    assert root.findtext("export/build_type") == "ament_python"
    assert re.fullmatch(r"[^@\s]+@[^@\s]+\.[a-z]+", root.find("maintainer").get("email"))
    assert (ROOT / "LICENSE").read_text().startswith("MIT License")


def test_every_message_package_in_use_is_a_dependency_of_package_xml():
    from msg_adapters import TOPICS

    root = ElementTree.parse(ROOT / "package.xml").getroot()
    declared = {e.text for e in root.findall("exec_depend")}
    assert {t.type_name.split("/")[0] for t in TOPICS.values()} | {"rclpy"} <= declared


@pytest.mark.parametrize("node", nodes())
def test_every_node_that_is_installed_exists(node):
    assert importlib.util.find_spec(f"csas_shadow_ros.nodes.{node}") is not None


def test_the_wheel_serves_ros2_run_and_the_ament_index(wheel):
    names = set(wheel.namelist())
    data = f"csas_shadow_ros-{csas_shadow_ros.__version__}.data/data"
    assert f"{data}/share/ament_index/resource_index/packages/csas_shadow_ros" in names
    assert f"{data}/share/csas_shadow_ros/package.xml" in names
    for node in ("csas-shadow", *nodes()):
        script = wheel.getinfo(f"{data}/lib/csas_shadow_ros/{node}")
        assert (script.external_attr >> 16) & 0o111 == 0o111, f"{node} cannot be executed"
        assert wheel.read(script).decode() == f'#!/bin/sh\nexec "$(dirname "$0")/../../bin/{node}" "$@"\n'


def test_the_wheel_holds_every_module_configuration_and_launch_file(wheel):
    names = set(wheel.namelist())
    for package in ("csas_shadow_ros", "msg_adapters"):
        for module in (ROOT / package).rglob("*.py"):
            assert str(module.relative_to(ROOT)) in names
    data = f"csas_shadow_ros-{csas_shadow_ros.__version__}.data/data/share/csas_shadow_ros"
    for folder in ("config", "launch"):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                assert f"{data}/{file.relative_to(ROOT)}" in names


def test_the_wheel_declares_a_command_for_each_node_and_the_extras(wheel):
    info = f"csas_shadow_ros-{csas_shadow_ros.__version__}.dist-info"
    entries = wheel.read(f"{info}/entry_points.txt").decode()
    assert "csas-shadow = csas_shadow_ros.__main__:main" in entries
    for node in nodes():
        assert f"{node} = csas_shadow_ros.nodes.runtime.start:{node}" in entries
    metadata = wheel.read(f"{info}/METADATA").decode()
    for extra in ("ros", "test", "dev"):
        assert f"Provides-Extra: {extra}" in metadata


def test_continuous_integration_checks_every_node():
    text = (ROOT / ".ci" / "run").read_text()
    assert text.count("$nodes") == 2
    (command,) = re.findall(r"nodes=\$\(\.venv/bin/python (.*)\)", text)
    done = subprocess.run(
        [sys.executable, *command.split()], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() == list(nodes())
