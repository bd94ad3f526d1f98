"""Containers and services: a root that cannot be written, a user without rights, kernels compiled before."""

from __future__ import annotations

import configparser
import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
UNITS = sorted(DEPLOY.glob("*.service"))
DOCKERFILES = sorted(DEPLOY.glob("Dockerfile.*"))


def commands(text: str) -> list[tuple[str, str]]:
    """Return instruction and rest of each line of a Dockerfile, continued lines joined."""
    joined = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", text, flags=re.M))
    return [(a.split()[0], a.split(None, 1)[1]) for a in joined.splitlines() if a.strip()]


@pytest.mark.parametrize("file", DOCKERFILES, ids=lambda f: f.name)
def test_an_image_compiles_its_kernels_before_it_gives_up_its_rights(file: Path) -> None:
    steps = commands(file.read_text())
    words = [name for name, _ in steps]
    assert words[0] == "FROM"
    (warm,) = (i for i, (name, rest) in enumerate(steps) if name == "RUN" and "csas-shadow warm" in rest)
    (user,) = (i for i, (name, rest) in enumerate(steps) if name == "USER")
    assert warm < user
    assert steps[user][1] != "root"
    for copied in re.findall(r"/src/(\S+)", file.read_text()):
        assert (ROOT / copied).exists(), f"{file.name} names {copied}, which is not there"


def test_every_service_of_the_compose_file_runs_read_only_and_names_what_exists() -> None:
    document = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    assert set(document["services"]) == {"graph", "recorder", "viewer"}
    for name, service in document["services"].items():
        assert service["read_only"] is True, name
        assert service["user"].startswith("${CSAS_UID"), name
        assert any(mount.startswith("/tmp") for mount in service["tmpfs"]), name
        assert (DEPLOY / service["build"]["context"] / service["build"]["dockerfile"]).exists(), name
        assert_command_exists(service["command"])


@pytest.mark.parametrize("file", UNITS, ids=lambda f: f.stem)
def test_a_unit_runs_as_a_user_of_its_own_and_names_what_exists(file: Path) -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(file)
    service = unit["Service"]
    assert service["DynamicUser"] == "yes"
    assert service["ProtectSystem"] == "strict"
    assert service["KillSignal"] == "SIGINT"
    assert_command_exists(service["ExecStart"].split("exec ", 1)[1].rstrip("'").split())


def assert_command_exists(words: list[str]) -> None:
    """Hold that a `ros2` command names a file or node of this package, and parameters that it has."""
    kind, package, what = words[1:4]
    assert (words[0], package) == ("ros2", "csas_shadow_ros")
    if kind == "launch":
        assert (ROOT / "launch" / what).exists()
        return
    assert kind == "run"
    assert importlib.util.find_spec(f"csas_shadow_ros.nodes.{what}") is not None
    known = yaml.safe_load((ROOT / "config" / "csas_shadow.yaml").read_text())[f"/**/{what}"][
        "ros__parameters"
    ]
    assert {w.split(":=")[0] for w in words if ":=" in w} - {"__ns"} <= set(known)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing")
@pytest.mark.parametrize("file", UNITS, ids=lambda f: f.stem)
def test_systemd_finds_no_fault_with_a_unit(file: Path) -> None:
    command = ["systemd-analyze", "verify", "--man=no", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
