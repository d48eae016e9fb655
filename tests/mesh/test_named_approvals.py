"""An approval that names its sender: on a mesh with certificates the name has to be proven."""

from __future__ import annotations

from pathlib import Path

import pytest
from fixtures.mesh_robots import Arm
from tests.mesh.peers import Fleet

from strands_robots.mesh.transport import config
from strands_robots.mesh.wire_identity import Identity, Signer, Verifier
from strands_robots.safety.authorization import Grants
from strands_robots.state_files import state_dir

WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 0.5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("keys")
    config.make_authority(made)
    for name in ("desk", "second", "arm-1"):
        config.issue_certificate(made, name)
    return made


class Site:
    """An arm that checks certificates, and consoles that may have one."""

    def __init__(self, peers: Fleet, folder: Path, *, required: bool) -> None:
        self._peers, self._folder, self._required = peers, folder, required
        self.arm = Arm()
        peers.join(self.arm, "arm-1", identity=self.identity("arm-1"))

    def identity(self, name: str) -> Identity:
        clock, folder = self._peers.clock, self._folder
        signer = Signer(folder / f"{name}.pem", folder / f"{name}.key", clock)
        return Identity(signer, Verifier((folder / "ca.pem").read_bytes(), clock, clock), required=self._required)

    def moves(self, peer_id: str, certificate: str = "") -> bool:
        """Ask for a motion as ``peer_id``, and return whether the arm began it."""
        identity = self.identity(certificate) if certificate else None
        console = self._peers.join(None, peer_id, identity=identity)
        before = len(self.arm.started)
        console.send("arm-1", WAVE, timeout=20)
        console.stop()
        return len(self.arm.started) > before


@pytest.fixture(params=["grant", "setting"])
def approve(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, peers: Fleet) -> object:
    def grant(caller: str) -> None:
        Grants(state_dir() / "grants").grant("start", "arm-1", caller=caller)

    def allow(caller: str) -> None:
        monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", f"start@arm-1:{caller}")

    return grant if request.param == "grant" else allow


@pytest.mark.parametrize("required", [True, False])
@pytest.mark.parametrize("peer_id", ["desk", "desk__console-1"])
def test_an_approval_is_for_the_sender_whose_certificate_proves_its_name(
    peers: Fleet, folder: Path, approve: object, required: bool, peer_id: str
) -> None:
    site = Site(peers, folder, required=required)
    assert callable(approve)
    approve("desk")
    assert not site.moves("second", "second")
    assert site.moves(peer_id, "desk")


@pytest.mark.parametrize("required", [True, False])
def test_a_name_that_is_only_claimed_matches_nothing_where_certificates_are_in_use(
    peers: Fleet, folder: Path, approve: object, required: bool
) -> None:
    site = Site(peers, folder, required=required)
    assert callable(approve)
    approve("desk")
    assert not site.moves("desk"), "the key of a console stood for a certificate"
    assert not site.moves("desk", "second"), "another's certificate stood for this one"
    assert site.moves("desk", "desk")


def test_the_key_of_a_console_still_uses_an_approval_for_all(peers: Fleet, folder: Path) -> None:
    site = Site(peers, folder, required=False)
    Grants(state_dir() / "grants").grant("start", "arm-1")
    assert site.moves("desk")


def test_without_certificates_the_name_in_a_consoles_signed_message_counts(peers: Fleet, approve: object) -> None:
    arm = Arm()
    peers.join(arm, "arm-1")
    assert callable(approve)
    approve("desk")
    for name, began in (("second", []), ("desk", ["wave"])):
        peers.join(None, name).send("arm-1", WAVE, timeout=20)
        assert arm.started == began
