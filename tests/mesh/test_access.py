"""The operator's access rules: who could move a robot by them, and what is said of it at the start."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest
from fixtures.access_rules import CMD, DENY, NO_COMMANDS, NOBODY, OPEN, rules

from strands_robots.mesh import topics
from strands_robots.mesh.transport import TransportError, config
from strands_robots.mesh.transport.config import Posture


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Make the posture of a certified peer with these rules."""
    config.make_authority(tmp_path / "keys")
    for name, value in config.issue_certificate(tmp_path / "keys", "arm-1").settings().items():
        monkeypatch.setenv(name, value)
    path = tmp_path / "acl.json5"
    monkeypatch.setenv("STRANDS_MESH_ACL_FILE", str(path))

    def posture(made: dict[str, Any] | str) -> Posture:
        path.write_text(made if isinstance(made, str) else json.dumps(made))
        return Posture.from_settings()

    return posture


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
    start(config.named_rules(["arm-1", "arm-2"], ["console"], namespace=namespace))
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
    assert {"strands/*/cmd", "strands/broadcast", "strands/*/input/*"} == set(config.MOVING)
    assert all(topics.topic_of(pattern.replace("*", "x")) is not topics.OTHER for pattern in config.MOVING)
