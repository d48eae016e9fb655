"""A certified operator leads a follower under rules that deny all else."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from fixtures.command_line import COMMAND
from fixtures.forked import COMMANDS, start
from fixtures.leaders import write_csv
from fixtures.waiting import free_port

from strands_robots.mesh.transport import config

pytest.importorskip("cryptography")


@pytest.fixture
def side(tmp_path: Path) -> Callable[..., Mapping[str, str]]:
    """The settings of one side, with its own certificate and the rules of both."""
    config.make_authority(tmp_path / "keys")

    def made(peer: str, relay: str, **more: str) -> Mapping[str, str]:
        rules = tmp_path / "rules.json5"
        rules.write_text(config.named_rules(["arm-1"], ["console"], [relay]), encoding="utf-8")
        state = tmp_path / peer
        state.mkdir(mode=0o700)
        issued = config.issue_certificate(tmp_path / "keys", peer, ["127.0.0.1"]).settings()
        own = {"STRANDS_STATE_DIR": str(state), "STRANDS_MESH_ACL_FILE": str(rules)}
        return {**os.environ, **own, **{name: str(value) for name, value in issued.items()}, **more}

    return made


@pytest.mark.parametrize("hub", ["console", "arm-1"])
def test_an_operator_leads_a_certified_peer(hub: str, side: Callable[..., Mapping[str, str]], tmp_path: Path) -> None:
    write_csv(tmp_path / "pan.csv", [(0.1 * step, {"shoulder_pan": 0.01 * step}) for step in range(31)])
    endpoint = f"tls/127.0.0.1:{free_port()}"
    way = {True: {"ZENOH_LISTEN": endpoint}, False: {"ZENOH_CONNECT": endpoint}}
    serving = start(
        [*COMMAND, "serve", "so100", "--mesh", "--peer-id", "arm-1", "--json"],
        imports=COMMANDS,
        stdout=subprocess.PIPE,
        text=True,
        env=side("arm-1", hub, **way[hub == "arm-1"]),
    )
    try:
        assert serving.stdout is not None
        assert json.loads(serving.stdout.readline())["peer_id"] == "arm-1"
        line = [*COMMAND, "replay", str(tmp_path / "pan.csv"), "--to", "mesh:arm-1", "--json"]
        environment = side("console", hub, **way[hub == "console"])
        done = subprocess.run(line, stdout=subprocess.PIPE, text=True, env=environment, check=False, timeout=90)
    finally:
        serving.kill()
        serving.communicate()
    report = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 0, report
    assert report["stopped"] is True
    assert report["frames"] > 10
