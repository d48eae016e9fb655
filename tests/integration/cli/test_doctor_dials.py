"""What ``doctor`` calls ok was dialled: routers and servers with TLS, served robots, and programs in their place."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.command_line import Machine
from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port
from fixtures.zenoh_router import ZenohRouter

pytestmark = pytest.mark.timeout(300)


def checks(machine: Machine, *flags: str) -> dict[str, dict[str, Any]]:
    """Return the findings of ``doctor`` by name; a later one of a name replaces the earlier."""
    return {each["name"]: each for each in machine.json("doctor", *flags)[1]["checks"]}


def files(identity: Identity) -> list[str]:
    return ["--tls-ca", str(identity.ca), "--tls-cert", str(identity.cert), "--tls-key", str(identity.key)]


def test_tls_endpoints_are_ok_only_where_the_other_side_takes_our_certificate(tmp_path: Path) -> None:
    machine, ours, theirs = Machine(tmp_path / "state"), Authority(tmp_path / "a"), Authority(tmp_path / "b", "other")
    own, foreign = ours.issue("arm"), theirs.issue("arm")
    mixed = Identity("arm", own.ca, foreign.cert, foreign.key)
    with ZenohRouter(own) as router, NatsServer(own) as nats:
        for flags in (["--connect", router.endpoint], ["--nats", nats.url]):
            good = checks(machine, *flags, *files(own))
            assert good["dial"]["mark"] == "ok" and good["certificates"]["mark"] == "ok"
            other = checks(machine, *flags, *files(foreign))
            assert other["dial"]["mark"] == "broken" and "its certificate is refused" in other["dial"]["said"]
        # A NATS server of the fixture asks no client for a certificate.
        refused = checks(machine, "--connect", router.endpoint, *files(mixed))
        assert "it refuses our certificate" in refused["dial"]["said"]
        assert "was not issued by" in refused["certificates"]["said"]
    gone = checks(machine, "--connect", router.endpoint, *files(own))
    assert gone["dial"]["mark"] == "broken" and "nothing listens there" in gone["dial"]["said"]


def test_ports_of_robots_are_ok_and_ports_of_other_programs_are_not(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")
    listener = f"tcp/127.0.0.1:{free_port()}"
    with machine.serving("arm-1"):
        assert "robots are served there" in checks(machine)["port"]["said"]
    with machine.serving("arm-1", "--listen", listener):
        assert checks(machine, "--connect", listener)["dial"]["mark"] == "ok"
        assert checks(machine, "--listen", listener)["listen"]["mark"] == "note"
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        number = stranger.getsockname()[1]
        for flags in (["--connect", f"tcp/127.0.0.1:{number}"], ["--nats", f"nats://127.0.0.1:{number}"]):
            assert checks(machine, *flags)["dial"]["mark"] == "broken"
        held = checks(machine, "--listen", f"tcp/127.0.0.1:{number}")["listen"]
        assert held["mark"] == "broken" and "another program holds the port" in held["said"]
        served = machine.run("serve", "so100", "--listen", f"tcp/127.0.0.1:{number}")
        assert served.returncode == 1
        assert "another program holds the port" in served.stderr
