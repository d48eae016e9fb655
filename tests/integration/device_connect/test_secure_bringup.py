"""Devices on authenticated networks, without any opt-in: mutual TLS through a router, between peers, and on NATS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.nats_credentials import NatsAccounts, Token
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import free_port
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect import FleetClient, LinkConfig, init_device_connect_sync, stop_device_connect


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


@pytest.fixture
def world() -> Iterator[ToyWorld]:
    toy = ToyWorld()
    yield toy
    toy.close()


def proven(identity: Identity, **where: object) -> LinkConfig:
    return replace(LinkConfig(ca=str(identity.ca), cert=str(identity.cert), key=str(identity.key)), **where)  # type: ignore[arg-type]


def drives(link: LinkConfig) -> None:
    with FleetClient(link, "operator") as fleet:
        assert [peer.id for peer in fleet.peers(20)] == ["arm-1"]
        assert fleet.call("arm-1", "execute", {"instruction": "wave"})["status"] == "success"
        assert fleet.stop("arm-1")["stopped"] == ["left"]


def test_through_a_router_with_mutual_tls(authority: Authority, world: ToyWorld) -> None:
    with ZenohRouter(authority.issue("router")) as router:
        where = {"connect": (router.endpoint,)}
        runtime = init_device_connect_sync(world, peer_id="arm-1", link=proven(authority.issue("arm-1"), **where))
        drives(proven(authority.issue("operator"), **where))
        stop_device_connect(runtime)


def test_environment_is_enough(authority: Authority, world: ToyWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = authority.issue("arm-1")
    with ZenohRouter(authority.issue("router")) as router:
        monkeypatch.setenv("ZENOH_CONNECT", router.endpoint)
        for part in ("ca", "cert", "key"):
            monkeypatch.setenv(f"MESSAGING_TLS_{part.upper()}_FILE", str(getattr(robot, part)))
        runtime = init_device_connect_sync(world, peer_id="arm-1")
        drives(proven(authority.issue("operator"), connect=(router.endpoint,)))
        stop_device_connect(runtime)


def test_between_peers_without_multicast(authority: Authority, world: ToyWorld) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    runtime = init_device_connect_sync(
        world, peer_id="arm-1", link=proven(authority.issue("arm-1"), mode="peer", listen=(endpoint,))
    )
    drives(proven(authority.issue("operator"), mode="peer", connect=(endpoint,)))
    with FleetClient(LinkConfig(mode="peer", connect=(endpoint.replace("tls/", "tcp/"),), multicast=False)) as stranger:
        assert stranger.peers(0.6) == []
    stop_device_connect(runtime)


def test_on_nats_with_tls_and_tokens(authority: Authority, world: ToyWorld, caplog: pytest.LogCaptureFixture) -> None:
    accounts = NatsAccounts()
    with NatsServer(authority.issue("server"), accounts.server_lines) as server:

        def link(token: Token) -> LinkConfig:
            return LinkConfig(
                transport="nats",
                connect=(server.url,),
                ca=str(authority.ca),
                jwt=token.jwt,
                nkey_seed=token.nkey_seed,
            )

        runtime = init_device_connect_sync(world, peer_id="arm-1", link=link(accounts.device("arm-1")))
        drives(link(accounts.operator()))
        stop_device_connect(runtime)
    assert "does not answer" not in caplog.text
