from __future__ import annotations

from pathlib import Path

import pytest
from fixtures.waiting import free_port
from tests.cli.conftest import Run

from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit
from strands_robots.fleet.device_connect.config import described
from strands_robots.utils import MissingExtraError


def test_without_flags_everything_stays_on_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_DC_PORT", "7555")
    link = Network().link()
    assert link.loopback_only
    assert link.meet_port == 7555
    assert "127.0.0.1:7555" in described(link)


def test_flag_outranks_the_network_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:7001")
    assert Network().link().connect == ("tcp/127.0.0.1:7001",)
    assert Network(port=7002).link().meet_port == 7002
    assert Network(connect=["tcp/127.0.0.1:7003"]).link().connect == ("tcp/127.0.0.1:7003",)


@pytest.mark.parametrize(
    "network",
    [
        Network(connect=["tcp/192.0.2.1:7447"]),
        Network(listen=["tcp/0.0.0.0:7447"]),
        Network(nats=["nats://192.0.2.1:4222"]),
        Network(multicast=True),
    ],
)
def test_unauthenticated_remote_network_is_refused_with_every_remedy(network: Network) -> None:
    with pytest.raises(CliError) as refused:
        network.link()
    assert refused.value.code is Exit.USAGE
    for remedy in ("--tls-ca", "--credentials", "--insecure"):
        assert remedy in refused.value.reason


def test_insecure_flag_or_certificates_allow_a_remote_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Network(nats=["nats://192.0.2.1:4222"], insecure=True).link().transport == "nats"
    for name in ("ca", "cert", "key"):
        (tmp_path / name).write_text("pem")
    files = {"tls_ca": tmp_path / "ca", "tls_cert": tmp_path / "cert", "tls_key": tmp_path / "key"}
    assert Network(connect=["tls/192.0.2.1:7447"], **files).link().authenticated
    monkeypatch.setenv("DEVICE_CONNECT_ALLOW_INSECURE", "yes")
    assert Network(listen=["tcp/0.0.0.0:7447"]).link().is_peer


def test_missing_extra_is_named_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("strands_robots.fleet.device_connect.config.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"the \[device-connect\] extra"):
        Network().link()


def test_broker_on_this_machine_needs_no_authentication() -> None:
    assert Network(nats=["nats://127.0.0.1:4222"]).link().loopback_only


def test_contradicting_flags_and_missing_files_are_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(CliError, match="--nats names a broker"):
        Network(nats=["nats://127.0.0.1:4222"], connect=["tcp/127.0.0.1:1"]).link()
    with pytest.raises(CliError, match=r"--tls-ca .* is no file"):
        Network(tls_ca=tmp_path / "absent").link()


def test_nats_takes_several_servers() -> None:
    link = Network(nats=["nats://127.0.0.1:4222,nats://127.0.0.1:4223", "nats://127.0.0.1:4224"]).link()
    assert [url.rpartition(":")[2] for url in link.connect] == ["4222", "4223", "4224"]


def url_with_a_password(port: int) -> str:
    return f"nats://ada:secret@127.0.0.1:{port}"


@pytest.mark.parametrize(
    "arguments",
    [["peers"], ["estop"], ["doctor"]],
    ids=lambda each: each[0],
)
def test_password_in_a_url_is_never_printed(
    run: Run,
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    url = url_with_a_password(free_port())
    monkeypatch.setenv("NATS_URL", url)
    monkeypatch.setenv("MESSAGING_BACKEND", "nats")
    output = run(*arguments, "--nats", url, "--insecure").output
    assert "secret" not in output + caplog.text
