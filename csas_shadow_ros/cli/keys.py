"""``csas-shadow keys``: keys and permissions of the nodes for SROS 2."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from .console import OK, Console
from .options import output_options


def add_keys(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``keys``."""
    keys = add(
        "keys",
        "make the keys and permissions of the nodes for SROS 2 (docs/security.md)",
        "  csas-shadow keys keystore --domain-id 7\n"
        "  export ROS_SECURITY_KEYSTORE=$PWD/keystore\n"
        "  export ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce\n"
        "  ros2 launch csas_shadow_ros csas_shadow.launch.py domain_id:=7\n\n"
        "Needs the extra security. Never replaces keys: renew them in a new folder.",
        _keys,
    )
    keys.add_argument("keystore", metavar="DIR", help="folder to make")
    keys.add_argument("--namespace", default="csas", help="namespace of the graph (default csas)")
    keys.add_argument("--domain-id", type=int, default=0, metavar="N", help="ROS domain (default 0)")
    keys.add_argument(
        "--days", type=int, default=365, metavar="N", help="days until the keys expire (default 365)"
    )
    output_options(keys)


def _keys(arguments: argparse.Namespace, console: Console) -> int:
    from ..security import make_keystore

    options = {name: getattr(arguments, name) for name in ("namespace", "domain_id", "days")}
    enclaves = make_keystore(arguments.keystore, **options)
    place = Path(arguments.keystore).resolve()
    console.result(
        f"{place}: keys of {len(enclaves)} enclaves for ROS domain {arguments.domain_id},"
        f" {arguments.days} days: {', '.join(enclaves)}\n"
        f"Keep {place / 'private'} off the vehicle: whoever has it can make keys.",
        {"keystore": str(place), "enclaves": enclaves, **options},
    )
    return OK
