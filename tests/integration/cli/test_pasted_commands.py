"""The commands of the banner of ``serve``, each pasted into another terminal, on every kind of network."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.command_line import WITHIN_S, Machine
from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port
from fixtures.zenoh_router import ZenohRouter

pytestmark = pytest.mark.timeout(300)


@contextmanager
def banner(machine: Machine, *flags: str, within: Path) -> Iterator[list[str]]:
    """Serve an arm from the folder ``within``; yield the commands that its banner names."""
    served = subprocess.Popen(
        [sys.executable, "-m", "strands_robots.cli", "serve", "so100", "--peer-id", "arm-1", *flags],
        env=machine.environment,
        cwd=within,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert served.stdout is not None
    shown = [served.stdout.readline()]
    while shown[-1] and "Ctrl-C" not in shown[-1]:
        shown.append(served.stdout.readline())
    try:
        assert len(shown) <= 10
        yield [line.strip() for line in shown if line.startswith("  ")]
    finally:
        served.terminate()
        warned = served.communicate(timeout=WITHIN_S)[1].splitlines()
    assert all(" strands_robots." in line for line in warned), "a library's warning"


def paste(machine: Machine, line: str, folder: Path) -> str:
    """Run a line in a shell elsewhere, which has only the state directory in common; return what it printed."""
    command = folder / "strands-robots"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m strands_robots.cli "$@"\n')
    command.chmod(0o700)
    environment = {name: value for name, value in machine.environment.items() if name != "STRANDS_DC_PORT"}
    environment["PATH"] = f"{folder}{os.pathsep}{environment['PATH']}"
    done = subprocess.run(
        ["sh", "-c", line], env=environment, cwd=folder, capture_output=True, text=True, timeout=WITHIN_S, check=False
    )
    assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
    assert done.stderr == "", line
    return done.stdout


@pytest.mark.parametrize("network", ["here", "tls peers", "tls router", "tls nats"])
def test_each_command_of_the_banner_works_as_pasted(network: str, tmp_path: Path) -> None:
    machine, elsewhere = Machine(tmp_path / "state"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    own = Authority(tmp_path / "pki").issue("arm")
    files = {"ca": own.ca, "cert": own.cert, "key": own.key}
    secured = [word for part, file in files.items() for word in (f"--tls-{part}", f"pki/{file.name}")]
    with running(network, own) as where:
        flags = [*where, *secured] if where else []
        with banner(machine, *flags, within=tmp_path) as lines:
            said = [paste(machine, line, elsewhere) for line in lines]
    assert [line.split()[1] for line in lines] == ["peers", "call", "stop", "estop"]
    assert "execute" in said[0] and "started: wave" in said[1] and "stopped" in said[2] and "locked" in said[3]


@contextmanager
def running(network: str, own: Identity) -> Iterator[list[str]]:
    """Start what the network needs; yield the flags that name it."""
    if network == "tls nats":
        with NatsServer(own) as nats:
            yield ["--nats", nats.url]
    elif network == "tls router":
        with ZenohRouter(own) as router:
            yield ["--connect", router.endpoint]
    else:
        yield ["--listen", f"tls/0.0.0.0:{free_port()}"] if network == "tls peers" else []
