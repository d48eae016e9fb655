"""The operator's access rules: who could move a robot by them, and what is said of it at the start."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest

from strands_robots.mesh import keys, topics
from strands_robots.mesh.transport import TransportError, access
from strands_robots.mesh.transport.zenoh_config import Posture

PUT = ["put", "declare_subscriber"]
BOTH = ["ingress", "egress"]
ESTOP = access.allow("stops", PUT, BOTH, ["strands/strands/safety/*"])
DENY = {"id": "no", "permission": "deny", "messages": ["put"], "flows": ["ingress"], "key_exprs": ["**"]}
NO_COMMANDS = DENY | {"key_exprs": ["**/cmd", "**/broadcast", "strands/strands/*/input/*"]}


def rules(
    keys_of_rule: list[str],
    subject: dict[str, Any] | None = None,
    *,
    messages: list[str] = PUT,
    flows: list[str] | None = BOTH,
    more: list[dict[str, Any]] | None = None,
    **fields: Any,
) -> dict[str, Any]:
    """Rules by which ``subject`` may what one rule says, and everyone may stop the fleet."""
    rule = {"id": "r", "permission": "allow", "messages": messages, "key_exprs": keys_of_rule}
    rule |= {} if flows is None else {"flows": flows}
    others = more or []
    made = access.deny_by_default(
        [rule, ESTOP, *others],
        [{"id": "who", **(subject or {})}, {"id": "all"}],
        [{"rules": ["r"], "subjects": ["who"]}, {"rules": ["stops", *(r["id"] for r in others)], "subjects": ["all"]}],
    )
    return made | fields


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Make the posture of a certified peer with these rules."""
    keys.init(tmp_path / "keys")
    for name, value in keys.issue(tmp_path / "keys", "arm-1").settings().items():
        monkeypatch.setenv(name, value)
    path = tmp_path / "acl.json5"
    monkeypatch.setenv("STRANDS_MESH_ACL_FILE", str(path))

    def posture(made: dict[str, Any] | str) -> Posture:
        path.write_text(made if isinstance(made, str) else json.dumps(made))
        return Posture.from_settings()

    return posture


CMD = "strands/strands/*/cmd"
OPEN = {
    "everything": rules(["**"]),
    "everything under the namespace": rules(["strands/**"]),
    "every topic of ours": rules(["strands/strands/**"]),
    "every command, at any depth": rules(["**/cmd"]),
    "every command": rules([CMD]),
    "the commands of one robot": rules(["strands/strands/arm-1/cmd"]),
    "part of a level": rules(["strands/st$*/arm-$*/c$*"]),
    "single levels": rules(["*/*/*/*"]),
    "the broadcast": rules(["**/broadcast"]),
    "the streams of leaders": rules(["strands/strands/*/input/*"]),
    "all that is one robot's": rules(["strands/strands/arm-1/**"]),
    "the second of two keys": rules(["strands/strands/*/presence", CMD]),
    "no flow stated": rules([CMD], flows=None),
    "incoming alone": rules([CMD], flows=["ingress"]),
    "put alone": rules([CMD], messages=["put"]),
    "null for a subject": rules([CMD], {"cert_common_names": None}),
    "every process of the machine": rules(["**"], {"interfaces": ["lo"]}),
    "an interface": rules([CMD], {"interfaces": ["eth0"]}),
    "a kind of link": rules([CMD], {"link_protocols": ["tls"]}),
    "a session id, which a peer chooses": rules([CMD], {"zids": ["a1b2"]}),
    "a user name, which no link of ours proves": rules([CMD], {"usernames": ["operator"]}),
    "a policy that joins everyone to a named rule": rules([CMD], {"cert_common_names": ["console"]})
    | {"policies": [{"rules": ["r", "stops"], "subjects": ["who", "all"]}]},
    "a deny that leaves a robot open": rules(["**"], more=[NO_COMMANDS | {"key_exprs": ["strands/strands/arm-1/cmd"]}]),
    "a deny of what goes out": rules([CMD], more=[NO_COMMANDS | {"flows": ["egress"]}]),
    "allowed by default": rules(["strands/strands/*/presence"], default_permission="allow"),
    "allowed by default, one topic denied": rules(
        ["strands/strands/*/presence"], default_permission="allow", more=[NO_COMMANDS | {"key_exprs": ["**/cmd"]}]
    ),
}


@pytest.mark.parametrize("made", OPEN.values(), ids=OPEN)
def test_rules_by_which_anyone_may_command_need_the_opt_in_and_are_said(
    start: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path, made: dict[str, Any]
) -> None:
    with pytest.raises(TransportError, match="STRANDS_MESH_ACCEPT_PERMISSIVE_ACL") as refused:
        start(made)
    monkeypatch.setenv("STRANDS_MESH_ACCEPT_PERMISSIVE_ACL", "true")
    assert start(made).access_control["enabled"]
    (line,) = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    for told in (str(refused.value), line):
        assert str(tmp_path / "acl.json5") in told
        assert ("rule 'r'" in told and ("'who'" in told or "'all'" in told)) or "default_permission" in told


NOBODY = {
    "every certificate": ("cert_common_names", ["*"]),
    "the second of two names": ("cert_common_names", ["console", "*"]),
    "part of a name": ("cert_common_names", ["arm-*"]),
    "every user": ("usernames", ["*"]),
    "every interface": ("interfaces", ["*"]),
}


@pytest.mark.parametrize(("field", "names"), NOBODY.values(), ids=NOBODY)
def test_wildcard_in_a_name_is_refused_by_name_because_zenoh_takes_it_literally(
    start: Any, monkeypatch: pytest.MonkeyPatch, field: str, names: list[str]
) -> None:
    monkeypatch.setenv("STRANDS_MESH_ACCEPT_PERMISSIVE_ACL", "true")
    with pytest.raises(TransportError, match=rf"subject 'who' has {field} '.*\*', which Zenoh takes literally"):
        start(rules(["**"], {field: names}))


CLOSED = {
    "one console": rules(["**"], {"cert_common_names": ["console"]}),
    "a console on one interface": rules(["**"], {"cert_common_names": ["console"], "interfaces": ["lo"]}),
    "to be told": rules(["**"], flows=["egress"]),
    "to listen": rules(["**"], messages=["declare_subscriber", "liveliness_token"]),
    "to ask, which moves nothing": rules(["**"], messages=["query", "reply", "declare_queryable"]),
    "telemetry": rules(["strands/strands/*/state", "strands/strands/*/camera/*"]),
    "to stop the fleet": rules(["strands/strands/safety/**"]),
    "a rule that no policy joins": rules([CMD]) | {"policies": [{"rules": ["stops"], "subjects": ["all"]}]},
    "commands denied to everyone": rules(["**"], more=[NO_COMMANDS]),
    "another namespace": rules(["other/strands/*/cmd"]),
}


@pytest.mark.parametrize("made", CLOSED.values(), ids=CLOSED)
def test_rules_that_name_who_may_command_start_without_a_word(
    start: Any, caplog: pytest.LogCaptureFixture, made: dict[str, Any]
) -> None:
    assert start(made).access_control["enabled"]
    assert [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING] == []


@pytest.mark.parametrize("namespace", ["strands", "plant/hall-2"])
def test_rules_of_the_key_command_start_without_a_word(
    start: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, namespace: str
) -> None:
    monkeypatch.setenv("STRANDS_MESH_NAMESPACE", namespace)
    start(keys.acl(["arm-1", "arm-2"], ["console"], namespace=namespace))
    assert [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING] == []


@pytest.mark.parametrize(
    "made",
    [
        rules([CMD], {"cert_common_names": ["console"]}) | {"policies": [{"rules": ["r"], "subjects": ["who"]}]},
        rules([CMD], {"cert_common_names": ["console"]}, more=[DENY]),
    ],
    ids=["no rule for stops", "stops denied"],
)
def test_rules_that_let_no_stop_in_are_said_at_start(
    start: Any, caplog: pytest.LogCaptureFixture, made: dict[str, Any]
) -> None:
    start(made)
    assert "no rule lets an emergency stop in" in caplog.text


def test_file_that_everyone_may_write_is_refused(start: Any, tmp_path: Path) -> None:
    (tmp_path / "acl.json5").touch()
    (tmp_path / "acl.json5").chmod(0o666)
    with pytest.raises(TransportError, match="chmod o-w"):
        start(rules([CMD], {"cert_common_names": ["console"]}))


def test_rules_without_certificates_are_said_to_have_no_effect(
    start: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("STRANDS_MESH_LOCAL_DEV", "true")
    assert start(rules(["**"])).access_control is None
    assert "STRANDS_MESH_TLS_CERT, STRANDS_MESH_TLS_KEY, STRANDS_MESH_ACL_FILE has no effect" in caplog.text


def test_every_topic_that_moves_a_robot_is_looked_at() -> None:
    assert {"strands/*/cmd", "strands/broadcast", "strands/*/input/*"} == set(access.MOVING)
    assert all(topics.topic_of(pattern.replace("*", "x")) is not topics.OTHER for pattern in access.MOVING)
