"""A device that listens on a fixed port: its runtime has that port, and its e-stop listener is still reached."""

from __future__ import annotations

from pathlib import Path

import pytest
from fixtures.certificates import Authority
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import free_port

from strands_robots.device_connect import LinkConfig, init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.safety_controller import safety_controller


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize("scheme", ["tcp", "tls"])
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_listening_device_is_stopped_by_whoever_connects_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scheme: str, host: str, mode: str
) -> None:
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path / "state"))
    authority, port, world = Authority(tmp_path), free_port(), ToyWorld("listener", robots=("left",))
    files = {}
    for name in ("device", "controller"):
        who = authority.issue(name)
        files[name] = {"ca": str(who.ca), "cert": str(who.cert), "key": str(who.key)} if scheme == "tls" else {}
    listening = LinkConfig(mode="peer", listen=(f"{scheme}/{host}:{port}",), **files["device"])
    runtime = init_device_connect_sync(world, peer_id="listener", link=listening, allow_insecure=True)
    try:
        world.start_policy("left", "wave", duration=300)
        there = LinkConfig(mode=mode, connect=(f"{scheme}/127.0.0.1:{port}",), **files["controller"])
        controller = safety_controller("controller", there)
        try:
            assert controller.wait_link(20)
            report = controller.stop(["listener"], "smoke", deadline_s=20)
        finally:
            controller.close()
        assert report.ok, report
        assert not world.list_policies_running()
    finally:
        world.close()
        stop_device_connect(runtime)
