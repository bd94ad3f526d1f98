"""Keys and permissions of the nodes: sound files, and exactly the topic contract."""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from datetime import datetime, timedelta, timezone
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="extra security is not installed")

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.nodes.runtime.params import NODES as REAL_NODES
from csas_shadow_ros.security import (
    NODES,
    REACH,
    KeystoreError,
    dds_topics,
    make_keystore,
    ros_topics,
)
from msg_adapters.topics import (
    DISPLAYS,
    OTHER_METHOD,
    PREFIXED_TOPICS,
    TOPICS,
    VIEW_STREAMS,
    absolute_name,
    is_topic,
    prefixed,
    stream,
)

#: What an enclave must hold for rmw_fastrtps and rmw_cyclonedds.
FILES = {
    *("identity_ca.cert.pem", "permissions_ca.cert.pem", "cert.pem", "key.pem"),
    *("governance.p7s", "permissions.p7s", "permissions.xml"),
}


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("keys") / "keystore"
    assert main(["keys", str(place), "--namespace", "auv_1/csas", "--domain-id", "42", "-q"]) == 0
    return place


def enclave_of(keystore: Path, name: str) -> Path:
    return keystore / "enclaves" / "auv_1" / "csas" / name


def openssl(*words: object, **options: object) -> subprocess.CompletedProcess[bytes]:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl")
    return subprocess.run(["openssl", *map(str, words)], capture_output=True, check=False, **options)  # type: ignore[call-overload]


def signed(folder: Path, name: str) -> bytes:
    """Return what a document says whose signature openssl has verified."""
    ca = folder / "permissions_ca.cert.pem"
    done = openssl("smime", "-verify", "-text", "-in", folder / name, "-CAfile", ca)
    assert done.returncode == 0, done.stderr
    return done.stdout.replace(b"\r\n", b"\n")


def test_each_node_has_an_enclave_whose_certificate_and_documents_are_signed(keystore: Path) -> None:
    assert set(NODES) == set(REAL_NODES)
    assert {p.name for p in enclave_of(keystore, "").iterdir()} == set(REACH)
    for name in REACH:
        folder = enclave_of(keystore, name)
        assert {p.name for p in folder.iterdir()} == FILES
        assert signed(folder, "permissions.p7s") == (folder / "permissions.xml").read_bytes()
        assert signed(folder, "governance.p7s") == (keystore / "enclaves" / "governance.xml").read_bytes()
        verified = openssl("verify", "-CAfile", folder / "identity_ca.cert.pem", folder / "cert.pem")
        assert verified.returncode == 0, verified.stderr
        certificate = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
        key = serialization.load_pem_private_key((folder / "key.pem").read_bytes(), None)
        assert certificate.public_key() == key.public_key()
        assert certificate.subject.rfc4514_string() == f"CN=/auv_1/csas/{name}"
        basic = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        assert not basic.ca, "it could sign keys"


def test_a_document_that_was_changed_is_no_longer_signed(keystore: Path, tmp_path: Path) -> None:
    folder = enclave_of(keystore, "composites")
    text = (folder / "permissions.p7s").read_bytes()
    changed = tmp_path / "permissions.p7s"
    changed.write_bytes(text.replace(b"multilook/image", b"voxel_grid/image"))
    assert changed.read_bytes() != text
    done = openssl("smime", "-verify", "-in", changed, "-CAfile", folder / "permissions_ca.cert.pem")
    assert done.returncode != 0
    assert b"digest failure" in done.stderr


def test_nobody_without_keys_may_join_and_all_is_encrypted(keystore: Path) -> None:
    (rule,) = ElementTree.parse(keystore / "enclaves" / "governance.xml").getroot().iter("domain_rule")
    assert [e.text for e in rule.findall("domains/id")] == ["42"]
    assert rule.findtext("allow_unauthenticated_participants") == "false"
    assert rule.findtext("enable_join_access_control") == "true"
    (topic,) = rule.iter("topic_rule")
    assert topic.findtext("topic_expression") == "*"
    for name in ("enable_read_access_control", "enable_write_access_control", "enable_discovery_protection"):
        assert topic.findtext(name) == "true"
    assert topic.findtext("metadata_protection_kind") == "ENCRYPT"
    assert topic.findtext("data_protection_kind") == "ENCRYPT"


def test_a_permission_holds_what_its_enclave_may_do_and_denies_the_rest(keystore: Path) -> None:
    for name in REACH:
        (grant,) = ElementTree.parse(enclave_of(keystore, name) / "permissions.xml").getroot().iter("grant")
        assert grant.findtext("subject_name") == f"CN=/auv_1/csas/{name}"
        assert grant.findtext("default") == "DENY"
        assert not list(grant.iter("deny_rule"))
        (rule,) = grant.iter("allow_rule")
        assert [e.text for e in rule.findall("domains/id")] == ["42"]
        subscribe, publish = dds_topics(name, "auv_1/csas")
        assert [e.text for e in rule.findall("publish/topics/topic")] == publish
        assert [e.text for e in rule.findall("subscribe/topics/topic")] == subscribe
        # No pattern: each name is one topic, not what may come to be called alike.
        assert not any(set("*?[") & set(text) for text in (*publish, *subscribe))
        begins, ends = (
            datetime.strptime(grant.findtext(f"validity/{end}") or "", "%Y-%m-%dT%H:%M:%S").replace(
                tzinfo=timezone.utc
            )
            for end in ("not_before", "not_after")
        )
        assert ends - begins == timedelta(days=366)
        assert begins < datetime.now(timezone.utc) - timedelta(hours=23)


CONTRACT = [
    *TOPICS,
    *(prefixed(p, n) for p in (OTHER_METHOD, "object_2", "object_64") for n in PREFIXED_TOPICS),
]


def test_every_topic_of_the_contract_is_published_and_heard_by_somebody_who_may() -> None:
    for name in CONTRACT:
        topic = absolute_name(name)
        hearing = {one for one in REACH if topic in ros_topics(one)[0]}
        giving = {one for one in REACH if topic in ros_topics(one)[1]}
        assert giving, f"nobody may publish {topic}"
        assert hearing >= {"bag_recorder", "operator"}, f"{topic} cannot be recorded"
    assert set(DISPLAYS) < set(TOPICS)


def test_no_permission_is_wider_than_the_contract() -> None:
    ros = ["/clock", "/parameter_events", "/rosout", "/tf_static", "/*/transition_event"]
    for name in REACH:
        for topic in set().union(*ros_topics(name)):
            of_contract = is_topic(topic.removeprefix("/csas/")) or topic in TOPICS
            assert of_contract or any(fnmatchcase(topic, one) for one in ros), f"{name}: {topic}"
    # A view has one author among the nodes, besides a player of bags: who has another's keys cannot feed it.
    authors = {"sub_aperture": "sub_aperture", "shadow": "shadow_enhancement"}
    for view in VIEW_STREAMS:
        image = absolute_name(stream(view).image_topic)
        assert {one for one in REACH if image in ros_topics(one)[1]} == {
            authors.get(view, "shadow_likelihood"),
            "bag_player",
        }
    # Who looks on changes nothing.
    assert not {t for t in ros_topics("operator")[1] if t.startswith("/csas")}
    assert {t for t in ros_topics("viewer")[1] if t.startswith("/csas")} == {
        "/csas/progress",
        "/csas/viewer/transition_event",
    }


def test_keys_are_their_owners_alone_and_the_keystore_is_whole_or_not_there(
    keystore: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = [p for p in keystore.rglob("*key.pem") if not p.is_symlink()]
    assert len(keys) == len(REACH) + 1
    assert {stat.S_IMODE(p.stat().st_mode) for p in keys} == {0o600}
    assert stat.S_IMODE(keystore.stat().st_mode) == 0o700

    def full(_: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("csas_shadow_ros.security.sync_tree", full)
    with pytest.raises(KeystoreError, match=r"cannot be made: .*No space left"):
        make_keystore(tmp_path / "place" / "keys")
    assert list((tmp_path / "place").iterdir()) == []


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"domain_id": 233}, "domain_id is 233; expected 0 to 232"),
        ({"days": 0}, "days is 0; expected 1 to 36500"),
        ({"namespace": "../etc"}, r"namespace is '\.\./etc'; expected letters"),
        ({"namespace": "a//b"}, "namespace is 'a//b'"),
        ({"namespace": "<x>"}, "namespace is '<x>'"),
    ],
)
def test_what_cannot_be_is_refused_by_name(tmp_path: Path, options: dict, match: str) -> None:
    with pytest.raises(ParameterError, match=match):
        make_keystore(tmp_path / "keys", **options)
    assert list(tmp_path.iterdir()) == []


def test_keys_that_are_there_are_not_replaced(keystore: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (keystore / "private" / "ca.key.pem").read_bytes()
    assert main(["keys", str(keystore)]) == 1
    assert "exists already; expected a new folder" in capsys.readouterr().err
    assert (keystore / "private" / "ca.key.pem").read_bytes() == before


def test_the_command_tells_the_enclaves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", str(tmp_path / "k"), "--namespace", "/", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["enclaves"] == [f"/{name}" for name in REACH]
    assert signed(tmp_path / "k" / "enclaves" / "sonar", "permissions.p7s")


def test_without_the_extra_the_command_says_how_to_get_it(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['cryptography'] = None\n"
        "from csas_shadow_ros.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "keys", str(tmp_path / "k")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "expected: pip install 'csas_shadow_ros[security]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
