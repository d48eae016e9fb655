"""Choice of a device's link, and the opt-in to an unauthenticated one."""

from __future__ import annotations

import atexit
import logging
from pathlib import Path
from typing import Any

import device_connect_agent_tools
import pytest
from fixtures.certificates import Authority
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import free_port

from strands_robots.device_connect import connect_agent, init_device_connect_sync
from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.device_connect.backends.config import insecure_opt_in, link_for
from strands_robots.utils import ValidationError


def test_zenoh_without_a_url_finds_peers_by_multicast() -> None:
    link = link_for(None, "zenoh", "default", None)
    assert link.is_peer
    assert link.uses_multicast
    assert link == link_for(None, None, "default", None)


@pytest.mark.parametrize(
    ("url", "backend", "transport"),
    [
        ("nats://127.0.0.1:4222", None, "nats"),
        ("tls://broker:4222", None, "nats"),
        ("tcp/127.0.0.1:7447", None, "zenoh"),
        ("zenoh://127.0.0.1:7447", None, "zenoh"),
        ("tcp/127.0.0.1:7447", "zenoh", "zenoh"),
    ],
)
def test_url_names_its_transport(url: str, backend: str | None, transport: str) -> None:
    link = link_for(url, backend, "lab", None)
    assert link.transport == transport
    assert link.tenant == "lab"
    assert len(link.connect) == 1


def test_explicit_url_outranks_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/10.0.0.1:7447")
    assert link_for("tcp/127.0.0.1:1", None, "default", None).connect == ("tcp/127.0.0.1:1",)
    assert link_for(None, None, "default", None).connect == ("tcp/10.0.0.1:7447",)


def test_nats_without_a_server_is_refused() -> None:
    with pytest.raises(ValidationError, match="messaging_url"):
        link_for(None, "nats", "default", None)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("http://x", None, "default", None), "messaging_url"),
        (("", None, "default", None), "messaging_url"),
        ((None, "mqtt", "default", None), "messaging_backend"),
        ((None, None, "a.b", None), "tenant"),
        ((None, None, "", None), "tenant"),
        ((None, None, "*", None), "tenant"),
        (("nats://x", None, "default", LinkConfig()), "link"),
    ],
)
def test_argument_out_of_its_domain_is_refused_by_name(arguments: tuple[Any, ...], named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        link_for(*arguments)


def test_unauthenticated_transport_is_refused_with_every_remedy() -> None:
    with pytest.raises(ValidationError) as refused:
        insecure_opt_in(None, LinkConfig(), stated=False)
    for way in (
        "link=loopback_config()",
        "allow_insecure=True",
        "DEVICE_CONNECT_ALLOW_INSECURE=true",
        "MESSAGING_TLS_CA_FILE",
        "CREDENTIALS",
    ):
        assert way in str(refused.value)


@pytest.mark.parametrize("word", ["true", "false", "", 1, 0, 1.0, []])
def test_opt_in_must_be_a_boolean_or_none(word: Any) -> None:
    with pytest.raises(ValidationError, match="allow_insecure"):
        insecure_opt_in(word, LinkConfig(), stated=False)


def test_opt_in_is_a_prominent_warning(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    with caplog.at_level(logging.WARNING):
        assert insecure_opt_in(True, LinkConfig(), stated=False)
    assert "INSECURE" in caplog.text
    monkeypatch.setenv("DEVICE_CONNECT_ALLOW_INSECURE", "true")
    assert insecure_opt_in(None, LinkConfig(), stated=False)
    with pytest.raises(ValidationError):
        insecure_opt_in(False, LinkConfig(), stated=False)


def test_unknown_spelling_is_no_opt_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_ALLOW_INSECURE", "yepp")
    with pytest.raises(ValidationError):
        insecure_opt_in(None, LinkConfig(), stated=False)


def test_stated_loopback_link_is_an_opt_in_that_is_logged_without_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert insecure_opt_in(None, loopback_config(7000), stated=True)
    assert "127.0.0.1" in caplog.text
    assert all(record.levelno == logging.INFO for record in caplog.records)
    with pytest.raises(ValidationError):
        insecure_opt_in(None, loopback_config(7000), stated=False)
    with pytest.raises(ValidationError):
        insecure_opt_in(False, loopback_config(7000), stated=True)
    with pytest.raises(ValidationError):
        insecure_opt_in(None, LinkConfig(listen=("tcp/0.0.0.0:7447",)), stated=True)


def test_certificates_need_no_opt_in(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    robot = Authority(tmp_path).issue("robot-1")
    link = LinkConfig(ca=str(robot.ca), cert=str(robot.cert), key=str(robot.key))
    assert not insecure_opt_in(None, link, stated=False)
    assert caplog.text == ""


def test_several_urls_with_commas_are_servers_of_one_link() -> None:
    link = link_for("nats://a:4222, nats://b:4222", None, "default", None)
    assert link.connect == ("nats://a:4222", "nats://b:4222")
    assert link_for("tcp/a:7447,tcp/b:7447", None, "default", None).connect == ("tcp/a:7447", "tcp/b:7447")


def test_zenoh_ignores_the_url_of_a_nats_server_and_the_other_way_round(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NATS_URL", "nats://127.0.0.1:4222")
    assert link_for(None, "zenoh", "default", None).uses_multicast
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:7447")
    assert link_for(None, "zenoh", "default", None).connect == ("tcp/127.0.0.1:7447",)
    assert link_for(None, "nats", "default", None).connect == ("nats://127.0.0.1:4222",)
    monkeypatch.delenv("NATS_URL")
    with pytest.raises(ValidationError, match="nats needs a server"):
        link_for(None, "nats", "default", None)


def test_nats_url_is_no_zenoh_endpoint() -> None:
    with pytest.raises(ValidationError, match=r"connect must be like tcp/host:port"):
        link_for("nats://user:secret@127.0.0.1:4222", "zenoh", "default", None)
    with pytest.raises(ValidationError) as refused:
        LinkConfig(connect=("nats://user:secret@127.0.0.1:4222",))
    assert "secret" not in str(refused.value)


def test_password_of_a_broker_that_does_not_answer_is_not_in_the_error(caplog: pytest.LogCaptureFixture) -> None:
    url = f"nats://ada:secret@127.0.0.1:{free_port()}"
    with pytest.raises(TimeoutError, match="was not up on") as failed:
        init_device_connect_sync(
            ToyRobot(), peer_id="arm-1", messaging_url=url, allow_insecure=True, bringup_timeout=1.0
        )
    assert "secret" not in f"{failed.value} {caplog.text}"


def test_agent_disconnects_at_the_end_of_its_process(monkeypatch: pytest.MonkeyPatch) -> None:
    at_exit: list[object] = []
    monkeypatch.setattr(atexit, "register", at_exit.append)
    monkeypatch.setattr(atexit, "unregister", lambda _: at_exit.clear())
    monkeypatch.setattr(device_connect_agent_tools, "connect", lambda: None)
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:1")
    for _ in range(2):
        connect_agent()
    assert at_exit == [device_connect_agent_tools.disconnect]


def test_server_whose_name_is_not_checked_is_said(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    own = Authority(tmp_path).issue("arm-1")
    files = {"ca": str(own.ca), "cert": str(own.cert), "key": str(own.key)}
    assert insecure_opt_in(None, LinkConfig(connect=("tls/router:7447",), **files), stated=True) is False
    assert caplog.text == ""
    link = LinkConfig(connect=("tls/router:7447",), verify_hostname=False, **files)
    assert insecure_opt_in(None, link, stated=True) is False
    assert "verify_hostname is False" in caplog.text
