"""Names of policy servers that are rebound, lie about where they lead, or never resolve."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from websockets.sync.server import ServerConnection, serve

from strands_robots.policies.remote import RemotePolicy
from strands_robots.serving import policy_arguments
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.policy_arguments import PolicyHosts
from strands_robots.utils import ValidationError

NAME = "gpu-1.lan"
GOOD, EVIL = "127.0.0.1", "127.0.0.2"


@pytest.fixture(autouse=True)
def listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_POLICY_HOST_ALLOW", NAME)
    monkeypatch.setattr(policy_arguments, "_HOSTS", PolicyHosts())


class Resolver:
    """A name server of an attacker: another answer each time."""

    def __init__(self, *answers: Sequence[str]) -> None:
        self.answers = list(answers)
        self.asked = 0

    def __call__(self, host: str, *rest: Any, **more: Any) -> list[Any]:
        answer = self.answers[min(self.asked, len(self.answers) - 1)]
        self.asked += 1
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (each, 0)) for each in answer]


@pytest.fixture
def servers() -> Iterator[tuple[int, dict[str, int]]]:
    """A port at which both addresses answer, and how often each was connected to."""
    counts = {GOOD: 0, EVIL: 0}

    def at(address: str) -> Any:
        def answer(connection: ServerConnection) -> None:
            counts[address] += 1
            for _ in connection:
                connection.send('{"id": 1, "type": "ready"}')

        return answer

    with serve(at(GOOD), GOOD, 0) as good:
        port = good.socket.getsockname()[1]
        with serve(at(EVIL), EVIL, port) as evil:
            threads = [threading.Thread(target=each.serve_forever, daemon=True) for each in (good, evil)]
            for each in threads:
                each.start()
            yield port, counts
            good.shutdown()
            evil.shutdown()
            for each in threads:
                each.join(20)


def checked(host: object) -> Any:
    options = {"instruction": "wave", "policy_provider": "remote", "duration": 1.0, "policy_host": host}
    return PEER_VERBS["start"].checked(options)["policy_host"]


def test_name_that_is_rebound_leads_to_the_address_that_was_checked(
    servers: tuple[int, dict[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    port, counts = servers
    rebinding, real = Resolver([GOOD], [EVIL]), socket.getaddrinfo
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda host, *a, **k: (rebinding if host == NAME else real)(host, *a, **k)
    )
    for _ in range(20):
        policy = RemotePolicy(checked(NAME), port)
        policy.reset("wave", {"pan.pos": (-1.0, 1.0)})
        policy.close()
    assert (rebinding.asked, counts) == (1, {GOOD: 20, EVIL: 0})


@pytest.mark.parametrize("address", ["169.254.169.254", "0.0.0.0", "224.0.0.1", "fe80::1", "240.0.0.1"])
def test_name_that_leads_to_no_servers_address_is_refused(address: str) -> None:
    with pytest.raises(ValidationError, match=r"policy_host 'gpu-1\.lan' resolves to .*, which is not the address"):
        PolicyHosts(lambda name: [address]).address(NAME)


@pytest.mark.parametrize("answer", [["10.1.0.1"], ["10.0.0.7", "10.1.0.1"]])
def test_name_that_leads_outside_the_listed_networks_is_refused(
    answer: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_MESH_POLICY_HOST_ALLOW", f"{NAME},10.0.0.0/16")
    assert PolicyHosts(lambda name: ["10.0.0.7"]).address(NAME) == "10.0.0.7"
    with pytest.raises(ValidationError, match=r"resolves to 10\.1\.0\.1, which is outside the addresses"):
        PolicyHosts(lambda name: answer).address(NAME)


def test_name_that_is_not_listed_is_never_resolved() -> None:
    hosts = PolicyHosts(lambda name: pytest.fail(f"{name} was resolved"))
    for host in ("evil.example", "gpu-1.lan.evil.example", "10.0.0.1", "2130706433", "0x7f.1", "localhost."):
        with pytest.raises(ValidationError, match="must be loopback or listed in STRANDS_MESH_POLICY_HOST_ALLOW"):
            hosts.address(host)


def test_resolver_that_hangs_holds_no_caller_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_arguments, "RESOLVE_S", 0.1)
    hang, asked = threading.Event(), []

    def resolve(name: str) -> list[str]:
        asked.append(name)
        hang.wait(60)
        return []

    hosts, began = PolicyHosts(resolve), time.monotonic()
    for _ in range(50):
        with pytest.raises(ValidationError, match=r"cannot be resolved: no answer in 0\.1 s"):
            hosts.address(NAME)
    assert len(asked) <= 1 + (time.monotonic() - began) / policy_arguments.FAILED_S
    hang.set()
