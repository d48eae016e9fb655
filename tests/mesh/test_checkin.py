"""The check-in of a live controller, and signed controllers, on the mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.mesh import safety
from strands_robots.mesh.resume_authority import keygen, load_signing_key
from strands_robots.utils import ValidationError

PASSPHRASE = "Correct-Horse-7-Battery"
REQUIRE = "STRANDS_ESTOP_REQUIRE_SIGNED"


@pytest.fixture(autouse=True)
def brief(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)


@pytest.fixture
def key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", keygen(tmp_path / "stop.pem", PASSPHRASE))
    monkeypatch.setenv(REQUIRE, "true")
    return load_signing_key(tmp_path / "stop.pem", PASSPHRASE)


def controllers(peers: Fleet, peer_id: str) -> dict[str, Any]:
    return peers.planes[peer_id].checkin.fields(0.0)["controllers"]  # type: ignore[return-value]


def test_robot_whose_console_falls_silent_halts_and_locks(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "1.5")
    arm = Arm()
    mesh, console = peers.join(arm, "arm-1"), peers.join(None, "console")
    console.check_in_every(0.05)
    eventually(lambda: "console" in controllers(peers, "arm-1"))
    status = console.send("arm-1", {"action": "status"}, timeout=20)["result"]
    assert (status["check_in"]["required"], list(status["check_in"]["controllers"])) == (True, ["console"])
    assert mesh.lockout_epoch is None
    console.close()
    eventually(lambda: mesh.lockout_epoch is not None)
    eventually(lambda: arm.halts)
    assert "check-in lost: console" in arm.halts[0]


def test_robot_without_a_timeout_needs_no_check_in(peers: Fleet) -> None:
    mesh, console = peers.join(Arm(), "arm-1"), peers.join(None, "console")
    console.check_in_every(0.05)
    assert controllers(peers, "arm-1") == {}
    assert mesh.lockout_epoch is None


@pytest.mark.parametrize(
    "change",
    [{"peer_id": "other"}, {"peer_id": 5}, {"peer_id": "console"}],
)
def test_check_in_in_anothers_name_does_not_count(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "60")
    peers.join(Arm(), "arm-1")
    peers.join(None, "console")
    peers.stranger().put("strands/console/checkin", {"t": peers.clock(), "nonce": "1" * 32, **change})
    eventually(lambda: peers.events("checkin_rejected"))
    assert controllers(peers, "arm-1") == {}


def test_controller_outside_the_allowlist_does_not_keep_a_robot_going(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "60")
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "safety-*")
    peers.join(Arm(), "arm-1")
    peers.join(None, "console").check_in_every(0.05)
    peers.join(None, "safety-1").check_in_every(0.05)
    eventually(lambda: peers.events("checkin_rejected"))
    eventually(lambda: list(controllers(peers, "arm-1")) == ["safety-1"])


def test_only_signed_stops_count_where_the_operator_chose_so(peers: Fleet, key: Any) -> None:
    arm = Arm()
    mesh, console = peers.join(arm, "arm-1"), peers.join(None, "console")
    seen = received(peers, "strands/safety/estop")
    console.emergency_stop()
    assert mesh.lockout_epoch is None
    assert any("is not signed" in each["reason"] for each in peers.events("estop_rejected"))
    console.emergency_stop(key)
    eventually(lambda: mesh.lockout_epoch == seen[-1]["estop_id"])
    peers.planes["arm-1"].clear_local("operator")
    forged = {**seen[-1], "estop_id": "a" * 32}
    stranger = peers.stranger()
    stranger.put("strands/safety/estop", {**forged, "source_zid": stranger.session_id})
    assert mesh.lockout_epoch is None


def test_plain_stop_is_never_refused_for_a_signature(peers: Fleet, key: Any) -> None:
    arm = Arm()
    peers.join(arm, "arm-1")
    answer = peers.join(None, "console").send("arm-1", {"action": "stop"}, timeout=20)
    assert answer["result"]["stopped"] and arm.halts


def test_signed_check_in_counts_once(peers: Fleet, key: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "60")
    peers.join(Arm(), "arm-1")
    seen = received(peers, "strands/console/checkin")
    console = peers.join(None, "console")
    console._safety.check_in()
    assert controllers(peers, "arm-1") == {}
    console._safety.check_in(key)
    eventually(lambda: list(controllers(peers, "arm-1")) == ["console"])
    refused = len(peers.events("checkin_rejected"))
    peers.transports["console"].put("strands/console/checkin", seen[-1])
    eventually(lambda: len(peers.events("checkin_rejected")) > refused)


@pytest.mark.parametrize("keys", ["", "no key"])
def test_signed_stops_without_a_usable_key_are_refused_at_the_start(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, keys: str
) -> None:
    monkeypatch.setenv(REQUIRE, "true")
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", keys)
    with pytest.raises(ValidationError, match=f"{REQUIRE}.*DEVICE_CONNECT_ESTOP_PUBLIC_KEYS"):
        peers.join(Arm(), "arm-1")
    assert peers.join(None, "console").alive


def test_one_press_is_one_stop_that_keeps_its_time(peers: Fleet) -> None:
    mesh, console = peers.join(Arm(), "arm-1"), peers.join(None, "console")
    seen = received(peers, "strands/safety/estop")
    console.emergency_stop(estop_id="b" * 32)
    pressed = peers.clock()
    peers.clock.pass_(3)
    console.emergency_stop(estop_id="b" * 32)
    assert {each["estop_id"] for each in seen} == {"b" * 32}
    assert mesh.lockout_epoch == "b" * 32
    assert {each["pressed_at"] for each in seen} == {pressed}
    assert seen[-1]["t"] == pressed + 3
