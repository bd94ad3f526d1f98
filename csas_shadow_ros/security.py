"""Keys for SROS 2: a keystore with an enclave for each node, whose permissions are the topic contract.

`make_keystore` writes what ``rmw_fastrtps`` and ``rmw_cyclonedds`` look for below ``ROS_SECURITY_KEYSTORE``
(DDS Security 1.1, section 9; the layout is that of ``ros2 security``): who may join, signed; for each
enclave a certificate, its key, and the topics and services that its holder may use, signed. `REACH` says who
takes and gives what. Tests hold it to the contract (`msg_adapters.topics`) and to what the nodes really open.
docs/security.md says what this guards against, and what it does not.
"""

from __future__ import annotations

import os
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from msg_adapters.topics import (
    FIRST_FURTHER,
    LAST_FURTHER,
    NAMESPACE,
    OTHER_METHOD,
    PREFIXED_TOPICS,
    STREAMS,
    TOPICS,
    VIEW_STREAMS,
    absolute_name,
    clean_namespace,
    prefixed,
)

from .core.errors import CsasError, MissingExtraError, ParameterError
from .durable import sync_tree

#: Of domains that exist; participants' ports end there (RTPS 9.6.1.1).
_MAX_DOMAIN_ID = 232
#: X.509 certificates have dates of four digits of a year; nobody's keys should last so long.
_MOST_DAYS = 36500
#: Clocks of vehicles and their base differ; sros2 begins a day early as well.
_SLACK = timedelta(days=1)
#: What every rclpy node answers, and whoever may set parameters asks.
_PARAMETER_SERVICES = (
    *("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters"),
    *("set_parameters", "set_parameters_atomically"),
)
#: The services of a managed node (rcl_lifecycle).
_LIFECYCLE_SERVICES = (
    *("change_state", "get_state", "get_available_states", "get_available_transitions"),
    "get_transition_graph",
)
_SERVICES = (*_PARAMETER_SERVICES, *_LIFECYCLE_SERVICES, "get_type_description")
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_SCHEMAS = "http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_{}.xsd"


class KeystoreError(CsasError):
    """A keystore cannot be made."""


@dataclass(frozen=True)
class Reach:
    """What the holder of an enclave may do, by names of streams and topics of the contract.

    Parameters
    ----------
    takes, gives : tuple of str
        Streams (both of their topics) and topics, without prefix; `progress`, `/diagnostics` and what every
        ROS node opens are not named.
    results : {"", "takes", "gives"}
        What it may do with the topics of further objects and of the other method's grid.
    node : bool
        Whether it is a node of this package, with parameters and a lifecycle.
    asks : bool
        Whether it may ask all nodes for their parameters and states, and change them.
    plain : tuple of tuple of str
        Topics besides, absolute: (takes, gives).
    """

    takes: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    results: str = ""
    node: bool = True
    asks: bool = False
    plain: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())


_RUN = ("image", "sector", "track", "origin")
_TARGET = ("search", "target")
_FOUND = (
    *("voxel_grid", "voxel_views", "matter", "voxels", "mesh", "matter/mesh"),
    *("objects", "measurements", "evidence", "scene_transform"),
)
_ALL = (*STREAMS, *(name for name in TOPICS if name.rpartition("/")[2] not in ("image", "camera_info")))

#: Who there is. The last two are outside nodes: a sonar processor, and a person with tools.
REACH: dict[str, Reach] = {
    "sub_aperture": Reach(("image", "sector", "track"), ("sub_aperture", *_TARGET)),
    "shadow_enhancement": Reach(("sub_aperture", *_TARGET), ("shadow", "shadow/display")),
    "shadow_likelihood": Reach(("shadow", *_TARGET), ("likelihood", "shadow_mask")),
    "voxel_carver": Reach(
        ("shadow", "likelihood", "shadow_mask", "track", "origin", *_TARGET),
        (*_FOUND, "origin"),  # where its parameters say it
        results="gives",
        plain=((), ("/tf_static",)),
    ),
    "composites": Reach(("sub_aperture", "track"), ("multilook", "color_by_aspect")),
    "bag_player": Reach((), (*_RUN, *VIEW_STREAMS, "target"), plain=((), ("/clock",))),
    "bag_recorder": Reach(_ALL, results="takes"),
    "viewer": Reach(
        (
            *(*VIEW_STREAMS, "multilook", "color_by_aspect", "voxel_grid", "voxel_views"),
            *("image", "track", "target", "measurements"),
        )
    ),
    "sonar": Reach((), _RUN, node=False),
    "operator": Reach(
        _ALL,
        results="takes",
        node=False,
        asks=True,
        plain=(("/clock", "/tf_static", "/rosout", "/parameter_events"), ()),
    ),
}
#: The nodes of `REACH`, whose services an operator may ask.
NODES = tuple(name for name, reach in REACH.items() if reach.node)


def topics_of(names: Iterable[str]) -> list[str]:
    """Return the topics of streams and topics: ``shadow`` becomes ``shadow/image`` and its camera_info.

    Examples
    --------
    >>> topics_of(["shadow", "track"])
    ['shadow/image', 'shadow/camera_info', 'track']
    """
    found: list[str] = []
    for name in names:
        if name in STREAMS:
            found += [STREAMS[name].image_topic, STREAMS[name].info_topic]
        else:
            found.append(TOPICS[name].name)
    return found


def _further() -> list[str]:
    """Return the result's topics that have a prefix."""
    prefixes = [f"object_{n}" for n in range(FIRST_FURTHER, LAST_FURTHER + 1)]
    return [prefixed(prefix, name) for prefix in (OTHER_METHOD, *prefixes) for name in PREFIXED_TOPICS]


def ros_topics(enclave: str, namespace: str = NAMESPACE) -> tuple[set[str], set[str]]:
    """Return the topics that the holder of an enclave may hear, and those that it may publish.

    Parameters
    ----------
    enclave : str
        A name of `REACH`.
    namespace : str
        That of the graph.

    Examples
    --------
    >>> hears, publishes = ros_topics("composites")
    >>> sorted(publishes)[:3]
    ['/csas/color_by_aspect/camera_info', '/csas/color_by_aspect/image', '/csas/composites/transition_event']
    >>> "/csas/sub_aperture/image" in hears, "/csas/sub_aperture/image" in publishes
    (True, False)
    """
    reach = REACH[enclave]
    takes, gives = topics_of(reach.takes), topics_of(reach.gives)
    takes += _further() if reach.results == "takes" else []
    gives += _further() if reach.results == "gives" else []
    if reach.node:
        takes.append("progress")
        gives += ["progress", "/diagnostics", f"{enclave}/transition_event"]
    hears = {absolute_name(name, namespace) for name in takes} | set(reach.plain[0])
    publishes = {absolute_name(name, namespace) for name in gives} | set(reach.plain[1])
    if reach.asks:
        hears |= {f"{clean_namespace(namespace)}/{node}/transition_event" for node in NODES}
    # Of every rclpy node; a node that goes by simulated time hears /clock.
    return hears | {"/clock", "/parameter_events"}, publishes | {"/rosout", "/parameter_events"}


def ros_services(enclave: str, namespace: str = NAMESPACE) -> tuple[set[str], set[str]]:
    """Return the services that the holder of an enclave answers, and those that it may ask.

    Examples
    --------
    >>> answers, asks = ros_services("composites")
    >>> "/csas/composites/set_parameters" in answers, asks
    (True, set())
    """
    space = clean_namespace(namespace)
    answers = {f"{space}/{enclave}/{name}" for name in _SERVICES} if REACH[enclave].node else set()
    asked = NODES if REACH[enclave].asks else ()
    return answers, {f"{space}/{node}/{name}" for node in asked for name in _SERVICES}


def dds_topics(enclave: str, namespace: str = NAMESPACE) -> tuple[list[str], list[str]]:
    """Return the DDS topics that the holder of an enclave may subscribe to, and those it may publish.

    ROS 2 puts ``rt`` before a topic's name, and makes two of a service: ``rq…Request`` and ``rr…Reply``.
    """
    hears, publishes = ros_topics(enclave, namespace)
    answers, asks = ros_services(enclave, namespace)
    # Which node has which endpoints: every ROS participant tells it.
    subscribe, publish = {"ros_discovery_info"}, {"ros_discovery_info"}
    subscribe |= {f"rt{name}" for name in hears}
    publish |= {f"rt{name}" for name in publishes}
    for name in answers:
        subscribe.add(f"rq{name}Request")
        publish.add(f"rr{name}Reply")
    for name in asks:
        publish.add(f"rq{name}Request")
        subscribe.add(f"rr{name}Reply")
    return sorted(subscribe), sorted(publish)


# -- the documents ----------------------------------------------------------------------------------------


def _document(kind: str) -> ElementTree.Element:
    return ElementTree.Element(
        "dds", {"xmlns:xsi": _XSI, "xsi:noNamespaceSchemaLocation": _SCHEMAS.format(kind)}
    )


def _add(parent: ElementTree.Element, tag: str, text: str = "", /, **attributes: str) -> ElementTree.Element:
    made = ElementTree.SubElement(parent, tag, attributes)
    made.text = text or None
    return made


def _domain(parent: ElementTree.Element, domain_id: int) -> None:
    _add(_add(parent, "domains"), "id", str(domain_id))


def _xml(document: ElementTree.Element) -> bytes:
    ElementTree.indent(document)
    return bytes(ElementTree.tostring(document, encoding="UTF-8", xml_declaration=True)) + b"\n"


def governance_xml(domain_id: int) -> bytes:
    """Write who may join a domain, and how all topics are guarded: nobody without keys, all encrypted.

    Examples
    --------
    >>> b"<allow_unauthenticated_participants>false<" in governance_xml(0)
    True
    """
    document = _document("governance")
    rule = _add(_add(document, "domain_access_rules"), "domain_rule")
    _domain(rule, domain_id)
    for name, value in (
        ("allow_unauthenticated_participants", "false"),
        ("enable_join_access_control", "true"),
        ("discovery_protection_kind", "ENCRYPT"),
        ("liveliness_protection_kind", "ENCRYPT"),
        ("rtps_protection_kind", "SIGN"),
    ):
        _add(rule, name, value)
    topic = _add(_add(rule, "topic_access_rules"), "topic_rule")
    for name, value in (
        ("topic_expression", "*"),
        ("enable_discovery_protection", "true"),
        ("enable_liveliness_protection", "true"),
        ("enable_read_access_control", "true"),
        ("enable_write_access_control", "true"),
        ("metadata_protection_kind", "ENCRYPT"),
        ("data_protection_kind", "ENCRYPT"),
    ):
        _add(topic, name, value)
    return _xml(document)


def permissions_xml(
    enclave: str, namespace: str, domain_id: int, not_before: datetime, not_after: datetime
) -> bytes:
    """Write what the holder of an enclave may do: `dds_topics`, and nothing else."""
    path = enclave_path(enclave, namespace)
    document = _document("permissions")
    grant = _add(_add(document, "permissions"), "grant", name=path)
    _add(grant, "subject_name", f"CN={path}")
    validity = _add(grant, "validity")
    for name, moment in (("not_before", not_before), ("not_after", not_after)):
        _add(validity, name, moment.strftime("%Y-%m-%dT%H:%M:%S"))
    rule = _add(grant, "allow_rule")
    _domain(rule, domain_id)
    subscribe, publish = dds_topics(enclave, namespace)
    for name, topics in (("publish", publish), ("subscribe", subscribe)):
        listed = _add(_add(rule, name), "topics")
        for topic in topics:
            _add(listed, "topic", topic)
    _add(grant, "default", "DENY")
    return _xml(document)


def enclave_path(enclave: str, namespace: str = NAMESPACE) -> str:
    """Return an enclave's name as ``--enclave`` takes it.

    Examples
    --------
    >>> enclave_path("composites", "auv_1")
    '/auv_1/composites'
    """
    return f"{clean_namespace(namespace)}/{enclave}"


# -- keys -------------------------------------------------------------------------------------------------


class _Authority:
    """Who signs: one certificate for identities and permissions, as ``ros2 security`` makes it."""

    def __init__(self, days: int) -> None:
        now = datetime.now(timezone.utc).replace(microsecond=0)
        self.not_before, self.not_after = now - _SLACK, now + timedelta(days=days)
        self.key: Any = None
        self.certificate: Any = None
        self.key, self.certificate = self.issue("csas_shadow_ros CA", authority=True)

    def issue(self, name: str, *, authority: bool = False) -> tuple[Any, Any]:
        """Make a key, on the curve that DDS Security asks for (9.3.1), and a certificate of it."""
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec

        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, name)])
        issuer = subject if authority else self.certificate.subject
        limit = x509.BasicConstraints(ca=authority, path_length=1 if authority else None)
        builder = x509.CertificateBuilder().issuer_name(issuer).subject_name(subject)
        builder = builder.public_key(key.public_key()).serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(self.not_before).not_valid_after(self.not_after)
        builder = builder.add_extension(limit, critical=authority)
        return key, builder.sign(key if authority else self.key, hashes.SHA256())

    def sign(self, document: bytes) -> bytes:
        """Sign a document as S/MIME, readable as it is (9.4.1)."""
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.serialization import pkcs7

        builder = pkcs7.PKCS7SignatureBuilder().set_data(document)
        builder = builder.add_signer(self.certificate, self.key, hashes.SHA256())
        options = [pkcs7.PKCS7Options.Text, pkcs7.PKCS7Options.DetachedSignature]
        return bytes(builder.sign(serialization.Encoding.SMIME, options))


def _pem(thing: Any) -> bytes:
    from cryptography.hazmat.primitives import serialization

    if not hasattr(thing, "private_bytes"):
        return bytes(thing.public_bytes(serialization.Encoding.PEM))
    kind = serialization.PrivateFormat.PKCS8
    return bytes(thing.private_bytes(serialization.Encoding.PEM, kind, serialization.NoEncryption()))


def _files(
    namespace: str, domain_id: int, days: int, enclaves: Iterable[str]
) -> Iterator[tuple[str, bytes | str]]:
    """Yield what a keystore holds: names with contents, or with what they link to."""
    authority = _Authority(days)
    yield "private/ca.key.pem", _pem(authority.key)
    yield "public/ca.cert.pem", _pem(authority.certificate)
    for role in ("identity", "permissions"):
        yield f"private/{role}_ca.key.pem", "ca.key.pem"
        yield f"public/{role}_ca.cert.pem", "ca.cert.pem"
    governance = governance_xml(domain_id)
    yield "enclaves/governance.xml", governance
    yield "enclaves/governance.p7s", authority.sign(governance)
    for enclave in enclaves:
        path = enclave_path(enclave, namespace)
        folder, up = f"enclaves{path}", "../" * path.count("/")
        key, certificate = authority.issue(path)
        yield f"{folder}/key.pem", _pem(key)
        yield f"{folder}/cert.pem", _pem(certificate)
        for role in ("identity", "permissions"):
            yield f"{folder}/{role}_ca.cert.pem", f"{up}../public/{role}_ca.cert.pem"
        yield f"{folder}/governance.p7s", f"{up}governance.p7s"
        validity = authority.not_before, authority.not_after
        permissions = permissions_xml(enclave, namespace, domain_id, *validity)
        yield f"{folder}/permissions.xml", permissions
        yield f"{folder}/permissions.p7s", authority.sign(permissions)


def make_keystore(
    keystore: str | Path, *, namespace: str = NAMESPACE, domain_id: int = 0, days: int = 365
) -> list[str]:
    """Make a keystore with an enclave for each node, a sonar processor and an operator.

    It appears whole or not at all, and only its owner may read its keys.

    Parameters
    ----------
    keystore : str or Path
        Folder to make; it must not exist.
    namespace : str
        Namespace of the graph.
    domain_id : int
        ROS domain that the keys are for.
    days : int
        How long they are valid, from now on.

    Returns
    -------
    list of str
        The enclaves, as ``--enclave`` and ``ROS_SECURITY_ENCLAVE_OVERRIDE`` take them.

    Raises
    ------
    KeystoreError
        If there is something already, or it cannot be written.
    ParameterError
        If the domain, the namespace or the days are out of range.
    MissingExtraError
        If cryptography is not installed.

    Examples
    --------
    >>> make_keystore("keys", domain_id=7)[0]  # doctest: +SKIP
    '/csas/sub_aperture'
    """
    if not 0 <= domain_id <= _MAX_DOMAIN_ID:
        raise ParameterError(f"domain_id is {domain_id}; expected 0 to {_MAX_DOMAIN_ID}")
    if not 1 <= days <= _MOST_DAYS:
        raise ParameterError(f"days is {days}; expected 1 to {_MOST_DAYS}")
    words = namespace.strip("/").split("/")
    if words != [""] and not all(word.isascii() and word.isidentifier() for word in words):
        raise ParameterError(
            f"namespace is {namespace!r}; expected letters, digits and underscores, as in 'auv_1/csas'"
        )
    try:
        import cryptography  # noqa: F401  only whether it is there
    except ModuleNotFoundError:
        raise MissingExtraError(
            "a keystore needs cryptography, which is not installed; expected: pip install"
            " 'csas_shadow_ros[security]'"
        ) from None
    place = Path(keystore)
    if place.exists() or place.is_symlink():
        raise KeystoreError(f"{place} exists already; expected a new folder: keys are not replaced")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        # A temporary directory is its owner's alone.
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as made:
            work = Path(made) / place.name
            work.mkdir(mode=0o700)
            for name, content in _files(namespace, domain_id, days, REACH):
                file = work / name
                file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                if isinstance(content, str):
                    file.symlink_to(content)
                    continue
                mode = 0o600 if name.endswith("key.pem") else 0o644
                with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as out:
                    out.write(content)
            sync_tree(work)
            work.rename(place)
    except OSError as error:
        raise KeystoreError(f"{place} cannot be made: {error}") from None
    return [enclave_path(enclave, namespace) for enclave in REACH]
