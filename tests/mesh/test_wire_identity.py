"""Signed messages: what a signature must be, and for whom it speaks."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Clock, Fleet

from strands_robots.mesh import wire_identity
from strands_robots.mesh.transport import config
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
from strands_robots.mesh.wire_identity import Identity, IdentityError, Signer, Verifier, identity_of

BODY = {"robot_id": "arm-1", "timestamp": 1.5, "nested": {"b": [1, "é"], "a": None}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("keys")
    config.make_authority(made)
    for name in ("arm-1", "arm-2"):
        config.issue_certificate(made, name)
    return made


def signer(folder: Path, name: str, clock: Clock) -> Signer:
    return Signer(folder / f"{name}.pem", folder / f"{name}.key", clock)


def verifier(folder: Path, clock: Clock) -> Verifier:
    return Verifier((folder / "ca.pem").read_bytes(), clock, clock)


def test_a_signed_message_is_verified_once(folder: Path) -> None:
    clock = Clock()
    signed, check = signer(folder, "arm-1", clock).sign(BODY), verifier(folder, clock)
    arrived = json.loads(json.dumps(signed))
    verified = check.verify(arrived)
    assert verified.common_name == "arm-1"
    with pytest.raises(IdentityError, match="nonce"):
        check.verify(arrived)


@pytest.mark.parametrize(
    ("peer", "speaks"),
    [("arm-1", True), ("arm-1__left", True), ("arm-10", False), ("arm-1_x", False), ("arm-2", False)],
)
def test_certificate_speaks_for_its_name_and_its_children(folder: Path, peer: str, speaks: bool) -> None:
    clock = Clock()
    identity = Identity(None, verifier(folder, clock), required=True)
    why = identity.refusal(signer(folder, "arm-1", clock).sign(BODY), peer)
    assert (why is None) is speaks


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "another body": lambda message: message.update(timestamp=2.5),
    "a field more": lambda message: message.update(extra=1),
    "a signature field more": lambda message: message["sig"].update(extra=1),
    "a signature field less": lambda message: message["sig"].pop("nonce"),
    "another version": lambda message: message["sig"].update(v=2),
    "a boolean version": lambda message: message["sig"].update(v=True),
    "another algorithm": lambda message: message["sig"].update(alg="ed25519"),
    "an unknown algorithm": lambda message: message["sig"].update(alg="none"),
    "another time": lambda message: message["sig"].update(t=message["sig"]["t"] + 1),
    "a time that is none": lambda message: message["sig"].update(t="now"),
    "another nonce": lambda message: message["sig"].update(nonce="00"),
    "no base64": lambda message: message["sig"].update(cert="%%%"),
    "no certificate": lambda message: message["sig"].update(cert=base64.b64encode(b"0" * 300).decode()),
    "a long certificate": lambda message: message["sig"].update(cert="A" * 9000),
    "a cut signature": lambda message: message["sig"].update(sig=message["sig"]["sig"][:-8]),
    "no signature": lambda message: message.pop("sig"),
    "a list": lambda message: message.update(sig=[1]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_signature_that_was_changed_does_not_count(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    clock = Clock()
    message = json.loads(json.dumps(signer(folder, "arm-1", clock).sign(BODY)))
    change(message)
    with pytest.raises(IdentityError):
        verifier(folder, clock).verify(message)


@pytest.mark.parametrize("shift", [61, -6, 400 * 86_400])
def test_a_signature_counts_only_near_its_time_and_its_certificates(folder: Path, shift: float) -> None:
    clock = Clock()
    message = signer(folder, "arm-1", clock).sign(BODY)
    clock.pass_(shift)
    with pytest.raises(IdentityError):
        verifier(folder, clock).verify(message)


def signed_elsewhere(tmp_path: Path, clock: Clock) -> dict[str, Any]:
    """A message of an ``arm-1`` of another authority."""
    config.make_authority(tmp_path)
    config.issue_certificate(tmp_path, "arm-1")
    return signer(tmp_path, "arm-1", clock).sign(BODY)


def test_a_certificate_of_another_authority_does_not_count(folder: Path, tmp_path: Path) -> None:
    clock = Clock()
    message = signed_elsewhere(tmp_path, clock)
    with pytest.raises(IdentityError, match="issued"):
        verifier(folder, clock).verify(message)


def test_a_certificate_whose_name_is_no_text_does_not_count(folder: Path) -> None:
    clock = Clock()
    signed = json.loads(json.dumps(signer(folder, "arm-1", clock).sign(BODY)))
    der = base64.b64decode(signed["sig"]["cert"] + "==")
    assert b"arm-1" in der
    signed["sig"]["cert"] = base64.b64encode(der.replace(b"arm-1", b"arm-\xff")).decode()
    with pytest.raises(IdentityError, match="cannot be read"):
        verifier(folder, clock).verify(signed)


def test_issuer_is_checked_before_the_validity_dates(folder: Path, tmp_path: Path) -> None:
    clock = Clock()
    message = signed_elsewhere(tmp_path, clock)
    clock.pass_(100 * 365 * 86400.0)
    with pytest.raises(IdentityError, match="issued"):
        verifier(folder, clock).verify(message)


@pytest.mark.parametrize(("policy", "required"), [("1", True), ("yes", True), ("TRUE", True), ("0", False)])
def test_unknown_policy_demands_signatures_on_every_transport_with_one_warning(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    policy: str,
    required: bool,
) -> None:
    monkeypatch.setenv("STRANDS_MESH_REQUIRE_SIGNED_IDENTITY", policy)
    wire_identity._unknown_policy.cache_clear()
    broker = MemoryTransport(MemoryBus(), sessionless=True)
    assert [identity_of(broker).required for _ in range(3)] == [required] * 3
    assert len([each for each in caplog.records if "taken as 1" in each.getMessage()]) == (policy not in "01")


@pytest.mark.parametrize("kind", ["rsa", "ed25519", "ecdsa"])
def test_every_algorithm_of_the_wire_signs_and_verifies(tmp_path: Path, kind: str) -> None:
    clock = Clock()
    config.make_authority(tmp_path)
    config.issue_certificate(tmp_path, "arm-1")
    if kind != "ecdsa":
        reissue(tmp_path, "arm-1", rsa.generate_private_key(65537, 2048) if kind == "rsa" else None)
    message = json.loads(json.dumps(signer(tmp_path, "arm-1", clock).sign(BODY)))
    assert message["sig"]["alg"].startswith(kind)
    assert verifier(tmp_path, clock).verify(message).common_name == "arm-1"


def reissue(folder: Path, name: str, key: Any) -> None:
    """The same certificate for a key of another kind."""
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - used here alone

    key = key or ed25519.Ed25519PrivateKey.generate()
    old = x509.load_pem_x509_certificate((folder / f"{name}.pem").read_bytes())
    signing = serialization.load_pem_private_key((folder / "ca.key").read_bytes(), None)
    assert isinstance(signing, ec.EllipticCurvePrivateKey)
    made = (
        x509.CertificateBuilder()
        .subject_name(old.subject)
        .issuer_name(old.issuer)
        .public_key(key.public_key())
        .serial_number(old.serial_number + 1)
        .not_valid_before(old.not_valid_before_utc)
        .not_valid_after(old.not_valid_after_utc)
        .sign(signing, hashes.SHA256())
    )
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    (folder / f"{name}.key").write_bytes(pem)
    (folder / f"{name}.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))


def test_in_signed_mode_an_unsigned_peer_is_listed_but_bound_to_nothing(peers: Fleet, folder: Path) -> None:
    roots = (folder / "ca.pem").read_bytes()
    clock = peers.clock

    def identity(name: str) -> Identity:
        return Identity(signer(folder, name, clock), Verifier(roots, clock, clock), required=True)

    console = peers.join(None, "arm-1", identity=identity("arm-1"))
    peers.join(World("left"), "arm-2", "sim", identity=identity("arm-2"))
    peers.join(Arm(), "plain")
    certificate = console.peer_cert("arm-2")
    assert certificate is not None
    assert certificate[1] == "arm-2"
    assert console.peer_cert("plain") is None
    assert console.peer_wire_zid("plain") is None
    assert console.get_peer("plain") is not None
    assert console.ping("arm-2", timeout=20)["status"] == "ok"
    assert peers.events("presence_unverified")

    def rejected() -> bool:
        assert console.ping("plain", timeout=0.2)["status"] == "timeout"
        return bool(peers.events("response_hijack_rejected"))

    eventually(rejected, what="an answer in time, which does not count")


def test_an_unsigned_heartbeat_does_not_rewrite_a_certified_living_peer(peers: Fleet, folder: Path) -> None:
    roots, clock = (folder / "ca.pem").read_bytes(), peers.clock

    def identity(name: str) -> Identity:
        return Identity(signer(folder, name, clock), Verifier(roots, clock, clock), required=True)

    console = peers.join(None, "arm-1", identity=identity("arm-1"), sessionless=True)
    arm = peers.join(World("left"), "arm-2", "sim", identity=identity("arm-2"), sessionless=True)
    thief = MemoryTransport(peers.bus, sessionless=True)
    thief.connect()
    heartbeat = {"robot_id": "arm-2", "robot_type": "impostor", "timestamp": clock()}
    for topic in ("arm-2", "thief"):
        thief.put(f"strands/{topic}/presence", heartbeat)
    assert console.peers_by_id["arm-2"]["type"] == "sim"
    assert console.peer_cert("arm-2") is not None
    assert peers.events("presence_identity_conflict")
    assert peers.events("presence_rejected")[0]["reason"] == "the topic and the body disagree"
    arm.stop()
    clock.pass_(10.5)
    thief.put("strands/arm-2/presence", {**heartbeat, "timestamp": clock()})
    assert console.peers_by_id["arm-2"]["type"] == "impostor"
    assert console.peer_cert("arm-2") is None
