"""Zenoh links whose certificate is expired, of another authority, or in another host's name: none opens.

For the mesh, and for the stop's own link of Device Connect; a true certificate beside them shows that the way is open.
"""

from __future__ import annotations

from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually, free_port
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import safety_controller

KINDS = ["expired", "another authority", "another host's name"]
WAIT_S = 2.0


def flawed(kind: str, folder: Path, name: str, authority: Authority) -> Identity:
    """A certificate of this kind; the authority is the fleet's, unless that is the flaw."""
    if kind == "expired":
        return authority.issue(name, lasts=timedelta(seconds=-10))
    if kind == "another authority":
        made = Authority(folder, "mallory").issue(name)
        return Identity(name, authority.ca, made.cert, made.key)
    return authority.issue(name, hosts=("robots.example",))


@pytest.mark.parametrize("kind", KINDS)
def test_stop_link_opens_no_connection_to_a_router_with_a_flawed_certificate(kind: str, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    own, true = authority.issue("safety-1"), authority.issue("router")
    with ZenohRouter(true) as router:
        link = client(router.endpoint, own)
        reached = safety_controller("safety-1", link)
        assert reached.wait_link(20.0)
        reached.close()
        port = router.port
    with ZenohRouter(flawed(kind, tmp_path / "flawed", "router-2", authority), port=port):
        refused = safety_controller("safety-1", link)
        assert not refused.wait_link(WAIT_S)
        refused.close()


@pytest.mark.parametrize("kind", KINDS[:2])
def test_router_takes_no_stop_link_with_a_flawed_certificate(kind: str, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    bad = flawed(kind, tmp_path / "flawed", "mallory", authority)
    with ZenohRouter(authority.issue("router")) as router:
        link = client(router.endpoint, bad)
        refused = safety_controller("safety-1", link)
        assert not refused.wait_link(WAIT_S)
        refused.close()


@pytest.mark.parametrize("kind", KINDS)
def test_peer_of_the_mesh_links_to_no_hub_with_a_flawed_certificate(kind: str, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    port, other = free_port(), free_port()
    hub, true_hub = f"tls/127.0.0.1:{port}", f"tls/127.0.0.1:{other}"
    bad = flawed(kind, tmp_path / "flawed", "console", authority)
    with ExitStack() as stack:

        def peer(name: str, robot: str, identity: Identity, variable: str, endpoints: str) -> MeshPeer:
            settings = {**_settings(identity, tmp_path, name), variable: endpoints}
            return stack.enter_context(MeshPeer(name, robot, settings))

        peer("console", "none", bad, "ZENOH_LISTEN", hub)
        true = peer("true-1", "none", authority.issue("true-1"), "ZENOH_LISTEN", true_hub)
        sim = peer("sim-1", "world", authority.issue("sim-1"), "ZENOH_CONNECT", f"{hub},{true_hub}")
        true.sees("sim-1")
        eventually(lambda: sim.ask("reachable") == ["true-1"])
        with pytest.raises(AssertionError):
            sim.sees("console", within=WAIT_S)


def client(endpoint: str, identity: Identity) -> LinkConfig:
    files = {"ca": str(identity.ca), "cert": str(identity.cert), "key": str(identity.key)}
    return LinkConfig(mode="client", connect=(endpoint,), **files)


def _settings(identity: Identity, folder: Path, name: str) -> dict[str, str]:
    state = folder / f"{name}-state"
    state.mkdir(mode=0o700)
    return {
        "STRANDS_MESH_TLS_CA": str(identity.ca),
        "STRANDS_MESH_TLS_CERT": str(identity.cert),
        "STRANDS_MESH_TLS_KEY": str(identity.key),
        "STRANDS_STATE_DIR": str(state),
    }
