"""A NATS link with TLS against servers that are not the one that is meant."""

import ssl
from dataclasses import replace

import pytest
from device_connect_edge.messaging.exceptions import MessagingError
from fixtures.certificates import Authority
from fixtures.lying_nats import LyingNatsServer
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, until

from strands_robots.device_connect.backends import LinkConfig, link_from_environment, open_client
from strands_robots.device_connect.stop_link import stop_link

ACCOUNT = "authorization { user: arm, password: secret }"


def links(port, ca):
    """Links that ask for TLS, each in another way, with a password and with a token."""
    plain, tls = f"nats://arm:secret@127.0.0.1:{port}", f"tls://arm:secret@127.0.0.1:{port}"
    token = {"jwt": "secret", "nkey_seed": "SUAMLK2ZNL35WSMW37E7UD4VZ7ELPKW7DHC3BWBSD2GCZ7IUQQXZIORRBU"}
    return {
        "tls URL": LinkConfig("nats", connect=(tls,)),
        "stated authority": LinkConfig("nats", connect=(plain,), ca=str(ca)),
        "one of two URLs": LinkConfig("nats", connect=(plain, tls)),
        "token": LinkConfig("nats", connect=(f"tls://127.0.0.1:{port}",), ca=str(ca), **token),
    }


@pytest.mark.parametrize("way", ["tls URL", "stated authority", "one of two URLs", "token"])
async def test_server_without_tls_receives_nothing(tmp_path, way):
    with LyingNatsServer() as liar:
        link = replace(links(liar.port, Authority(tmp_path).ca)[way], connect_timeout_s=1.2)
        with pytest.raises(MessagingError, match="does not speak TLS"):
            await open_client(link)
        await until(lambda: liar.visits >= 2, what="more than one try")
        assert bytes(liar.received) == b""


async def test_server_without_tls_receives_nothing_of_a_stop_link(tmp_path):
    with LyingNatsServer() as liar:
        link = stop_link(links(liar.port, Authority(tmp_path).ca)["stated authority"])
        states = []
        link.open(("emergencyStop",), lambda *event: None, states.append)
        try:
            await until(lambda: liar.visits >= 2, what="more than one try")
            assert not link.publish("controller", "emergencyStop", b"{}")
        finally:
            link.close()
        assert bytes(liar.received) == b""
        assert True not in states


async def test_impostor_without_tls_receives_nothing_when_the_server_goes(tmp_path):
    identity = Authority(tmp_path).issue("nats")
    with NatsServer(identity, ACCOUNT) as server:
        client = await open_client(links(server.port, identity.ca)["stated authority"])
        try:
            server.kill()
            await until(lambda: not client.is_connected)
            with LyingNatsServer(server.port) as liar:
                await until(lambda: liar.visits >= 2, what="more than one try")
                assert bytes(liar.received) == b""
            server.start()
            await until(lambda: client.is_connected)
        finally:
            await client.close()


@pytest.mark.parametrize("wrong", ["name", "authority"])
async def test_server_that_is_not_the_one_asked_for_is_refused_from_the_environment(tmp_path, monkeypatch, wrong):
    ours, theirs = Authority(tmp_path, "ours"), Authority(tmp_path, "theirs")
    identity = ours.issue("nats", hosts=("other.example",)) if wrong == "name" else theirs.issue("nats")
    # What the system trusts does not count beside a stated authority.
    monkeypatch.setenv("SSL_CERT_FILE", str(theirs.ca))
    assert ssl.create_default_context().get_ca_certs()
    with NatsServer(identity, ACCOUNT) as server:
        monkeypatch.setenv("NATS_URL", server.url.replace("//", "//arm:secret@"))
        monkeypatch.setenv("MESSAGING_TLS_CA_FILE", str(ours.ca))
        link = replace(link_from_environment(), connect_timeout_s=1.2)
        with pytest.raises(MessagingError, match="certificate"):
            await open_client(link)


async def test_authority_of_the_system_counts_where_none_is_stated(tmp_path, monkeypatch):
    authority = Authority(tmp_path)
    monkeypatch.setenv("SSL_CERT_FILE", str(authority.ca))
    with NatsServer(authority.issue("nats"), ACCOUNT) as server:
        monkeypatch.setenv("NATS_URL", server.url.replace("//", "//arm:secret@"))
        link = link_from_environment()
        assert link.authenticated
        client = await open_client(link)
        assert client.is_connected
        await client.close()


async def test_stop_link_reaches_the_true_server(tmp_path):
    identity = Authority(tmp_path).issue("nats")
    with NatsServer(identity, ACCOUNT) as server:
        link = stop_link(links(server.port, identity.ca)["stated authority"])
        received = []
        link.open(("emergencyStop",), lambda event, source, payload: received.append(payload), lambda up: None)
        try:
            eventually(lambda: link.up)
            assert link.publish("controller", "emergencyStop", b"now")
            eventually(lambda: received == [b"now"])
        finally:
            link.close()
