"""A stranger without keys can neither publish nor listen, nor can a node beyond its permissions.

PyPI's ROS 2 has a middleware without security. So the files of a keystore are tried with Fast DDS alone,
given as rmw_fastrtps gives them, where the system has one that was built with security (Debian and Ubuntu:
libfastrtps-dev).
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="extra security is not installed")

from csas_shadow_ros.graph import DomainReservation
from csas_shadow_ros.security import make_keystore

pytestmark = pytest.mark.long

SOURCE = Path(__file__).with_name("peer.cpp")
VIEWS, GRID = "rt/csas/sub_aperture/image", "rt/csas/voxel_grid/image"
#: Discovery with keys takes half a second on an idle machine.
SECONDS = 6
WORDS = ("published", "heard ", "refused: ")
Pair = Callable[..., tuple[str, str]]


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("g++")
    if compiler is None or not Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp").exists():
        pytest.skip("no g++ with Fast DDS: apt-get install g++ libfastrtps-dev")
    made = tmp_path_factory.mktemp("peer") / "peer"
    # The system's, not the wheels', which have no security.
    plain = {k: v for k, v in os.environ.items() if k != "LD_LIBRARY_PATH"}
    build = [compiler, "-std=c++17", str(SOURCE), "-o", str(made), "-lfastrtps", "-lfastcdr"]
    subprocess.run(build, check=True, env=plain)
    return made


@pytest.fixture
def pair(peer: Path, tmp_path: Path) -> Iterator[Pair]:
    with DomainReservation() as domain:
        make_keystore(tmp_path / "keys", domain_id=domain)
        make_keystore(tmp_path / "others", domain_id=domain)
        environment = {k: v for k, v in os.environ.items() if k != "LD_LIBRARY_PATH"}

        def start(does: str, topic: str, enclave: str) -> subprocess.Popen[str]:
            keys, _, name = enclave.rpartition("/")
            where = str(tmp_path / (keys or "keys") / "enclaves/csas" / name) if enclave else "-"
            command = [str(peer), str(domain), does, topic, str(SECONDS), where]
            return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)

        def run(topic: str, publishes: str, hears: str) -> tuple[str, str]:
            """Return what a publisher and a listener tell; an empty enclave is a stranger without keys."""
            both = [start("publish", topic, publishes), start("hear", topic, hears)]
            told = [p.communicate(timeout=60)[0].splitlines() for p in both]
            # Fast DDS logs there, too.
            first, second = ([x.strip() for x in lines if x.startswith(WORDS)] for lines in told)
            return first[0], second[0]

        yield run


def heard(told: str) -> int:
    word, _, number = told.partition(" ")
    assert word == "heard", told
    return int(number)


def test_two_strangers_hear_each_other(pair: Pair) -> None:
    # Else the others' silence would mean nothing.
    assert heard(pair(VIEWS, "", "")[1]) > 10


def test_nodes_with_keys_hear_each_other(pair: Pair) -> None:
    assert heard(pair(VIEWS, "sub_aperture", "shadow_enhancement")[1]) > 10
    assert heard(pair(GRID, "voxel_carver", "operator")[1]) > 10


@pytest.mark.parametrize("stranger", ["", "others/sub_aperture"], ids=["without keys", "with other keys"])
def test_a_stranger_cannot_publish(pair: Pair, stranger: str) -> None:
    assert pair(VIEWS, stranger, "shadow_enhancement") == ("published", "heard 0")


@pytest.mark.parametrize("stranger", ["", "others/operator"], ids=["without keys", "with other keys"])
def test_a_stranger_cannot_listen(pair: Pair, stranger: str) -> None:
    assert pair(VIEWS, "sub_aperture", stranger) == ("published", "heard 0")


def test_a_node_cannot_publish_or_hear_what_its_permissions_do_not_name(pair: Pair) -> None:
    assert pair(GRID, "composites", "operator") == ("refused: endpoint", "heard 0")
    assert pair(GRID, "voxel_carver", "composites")[1] == "refused: endpoint"
