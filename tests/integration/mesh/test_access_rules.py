"""Access rules in the real Zenoh: which of them let a robot command another one, and what the start says of them."""

from __future__ import annotations

import json
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from fixtures.certificates import Authority, Identity
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter
from tests.integration.mesh.conftest import Join

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.mesh.transport import config

CMD = "strands/strands/*/cmd"


def with_open_rule(folder: Path, subject: dict[str, Any], key: str) -> Path:
    """Rules by which only the console commands, and ``subject`` by one rule more."""
    rules = json.loads(config.named_rules(["sim-1", "sim-2"], ["console"]))
    rules["rules"].append(
        {"id": "open", "permission": "allow", "messages": ["put"], "flows": ["ingress"], "key_exprs": [key]}
    )
    rules["subjects"].append({"id": "who", **subject})
    rules["policies"].append({"rules": ["open"], "subjects": ["who"]})
    path = folder / "acl.json5"
    path.write_text(json.dumps(rules))
    return path


@pytest.fixture
def fleet(tmp_path: Path) -> dict[str, dict[str, str]]:
    folder = tmp_path / "keys"
    config.make_authority(folder)
    return {name: config.issue_certificate(folder, name).settings() for name in ("console", "sim-1", "sim-2")}


OPEN = [({}, CMD), ({}, "**/cmd"), ({}, "**"), ({"interfaces": ["lo"]}, CMD)]


@pytest.mark.parametrize(("subject", "key"), OPEN, ids=[f"{who} {key}" for who, key in OPEN])
def test_rule_that_names_no_certificate_lets_a_robot_command_another(
    join: Join, fleet: dict[str, dict[str, str]], tmp_path: Path, subject: dict[str, Any], key: str
) -> None:
    acl = str(with_open_rule(tmp_path, subject, key))
    refused = join("console", "none", **fleet["console"], STRANDS_MESH_ACL_FILE=acl)
    assert refused.ask("alive") is False
    refused.close()
    opened = {"STRANDS_MESH_ACL_FILE": acl, "STRANDS_MESH_ACCEPT_PERMISSIVE_ACL": "true"}
    hub = join("console", "none", **fleet["console"], **opened)
    one, two = _robots(join, fleet, opened)
    hub.sees("sim-1", "sim-2")
    one.sees("sim-2")
    assert one.ask("ping", "sim-2")["status"] == "ok"
    two.close()


def test_star_for_a_certificate_opens_nothing_in_zenoh_and_is_refused_here(
    join: Join, fleet: dict[str, dict[str, str]], tmp_path: Path
) -> None:
    acl = str(with_open_rule(tmp_path, {"cert_common_names": ["*"]}, "**"))
    peer = join("sim-1", **fleet["sim-1"], STRANDS_MESH_ACL_FILE=acl, STRANDS_MESH_ACCEPT_PERMISSIVE_ACL="true")
    assert peer.ask("alive") is False


def _robots(join: Join, fleet: dict[str, dict[str, str]], settings: dict[str, str]) -> tuple[MeshPeer, MeshPeer]:
    return join("sim-1", **fleet["sim-1"], **settings), join("sim-2", **fleet["sim-2"], **settings)


LETS_IN = {
    "nothing stated": ({}, True),
    "the name": ({"cert_common_names": ["mallory"]}, True),
    "another name": ({"cert_common_names": ["console"]}, False),
    "a star": ({"cert_common_names": ["*"]}, False),
    "a star in a name": ({"cert_common_names": ["mal*"]}, False),
    "the loopback interface": ({"interfaces": ["lo"]}, True),
    "another interface": ({"interfaces": ["eth9"]}, False),
    "any interface": ({"interfaces": ["*"]}, False),
    "the kind of link": ({"link_protocols": ["tls"]}, True),
    "any user": ({"usernames": ["*"]}, False),
}


@pytest.mark.parametrize(("subject", "through"), LETS_IN.values(), ids=LETS_IN)
def test_zenoh_takes_each_name_of_a_subject_literally(tmp_path: Path, subject: dict[str, Any], through: bool) -> None:
    authority = Authority(tmp_path)
    known, own = {"id": "arm", "cert_common_names": ["arm"]}, {"id": "who", **subject}
    put = config.allow("open", ["put"], ["ingress"], [CMD])
    hear = config.allow("hear", ["put", "declare_subscriber"], ["ingress", "egress"], ["strands/strands/**"])
    told = config.allow("told", ["declare_subscriber"], ["egress"], ["**"])
    policies = [{"rules": ["open"], "subjects": ["who"]}, {"rules": ["hear"], "subjects": ["arm"]}]
    everyone = {"rules": ["told"], "subjects": ["all"]}
    rules = config.deny_by_default([put, hear, told], [known, own, {"id": "all"}], [*policies, everyone])
    received: list[str] = []
    with ZenohRouter(authority.issue("router"), rules) as router, ExitStack() as sessions:
        arm, mallory = (
            sessions.enter_context(_session(router.endpoint, authority.issue(name))) for name in ("arm", "mallory")
        )
        arm.declare_subscriber("strands/strands/*/*", lambda sample: received.append(str(sample.key_expr)))
        publisher = mallory.declare_publisher("strands/strands/arm/cmd")
        eventually(lambda: publisher.matching_status.matching, what="the subscriber is known")
        publisher.put(b"move")
        # What follows on the same link arrives after it.
        own_put = sessions.enter_context(_session(router.endpoint, authority.issue("arm", lasts=timedelta(hours=1))))
        eventually(lambda: own_put.put("strands/strands/arm/state", b"") or received, what="the subscriber receives")
        if through:
            eventually(lambda: "strands/strands/arm/cmd" in received, what="the command")
        else:
            passes = 5
            for _ in range(passes):
                publisher.put(b"move")
            eventually(lambda: own_put.put("strands/strands/arm/state", b"") or len(received) > passes)
            assert "strands/strands/arm/cmd" not in received


def _session(endpoint: str, identity: Identity) -> zenoh.Session:
    link = LinkConfig(
        mode="client", connect=(endpoint,), ca=str(identity.ca), cert=str(identity.cert), key=str(identity.key)
    )
    return zenoh.open(zenoh.Config.from_json5(json.dumps(link.zenoh())))
