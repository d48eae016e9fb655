"""Signed resumes: what is admitted, and what each of the checks refuses."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from strands_robots.safety import ed25519
from strands_robots.safety.resume import (
    ASSERTION_MAX_BYTES,
    BACK_OFF_S,
    Admitted,
    Denial,
    ResumeVerifier,
    configured_keys,
    sign,
)
from strands_robots.utils import ValidationError, canonical_json

EPOCH = "a" * 32
OTHER = "b" * 32
NOW = 1_700_000_000.0
GOOD = "Correct-Horse-7-Battery"


class Clock:
    """Both clocks, moved by hand."""

    def __init__(self) -> None:
        self.wall, self.steady = NOW, 0.0

    def move(self, seconds: float) -> None:
        self.wall += seconds
        self.steady += seconds


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def key() -> Ed25519PrivateKey:
    return Ed25519PrivateKey.generate()


def verifier(key: Any, clock: Clock, *names: str) -> ResumeVerifier:
    keys = (ed25519.public_half(key),) if key else ()
    return ResumeVerifier(names or ("arm-1",), lambda: keys, lambda: clock.wall, lambda: clock.steady)


def resigned(key: Any, assertion: dict[str, Any], **changes: Any) -> dict[str, Any]:
    body = {k: v for k, v in {**assertion, **changes}.items() if k != "sig"}
    return {**body, "sig": ed25519.encode(key.sign(canonical_json(body)))}


def one(key: Any, clock: Clock, *targets: str) -> dict[str, Any]:
    (assertion,) = sign(key, EPOCH, targets or ("arm-1",), clock=lambda: clock.wall)
    return assertion


def test_a_fresh_signed_assertion_clears_the_epoch_it_names(key: Any, clock: Clock) -> None:
    assert verifier(key, clock).check(one(key, clock), [OTHER, EPOCH]) == Admitted(EPOCH)


def test_it_survives_the_wire_and_an_unpadded_signature(key: Any, clock: Clock) -> None:
    assertion = json.loads(json.dumps(one(key, clock)))
    assertion["sig"] = assertion["sig"].rstrip("=")
    assert verifier(key, clock).check(assertion, [EPOCH]) == Admitted(EPOCH)


def test_a_second_key_serves_while_keys_are_rotated(key: Any, clock: Clock) -> None:
    fresh = Ed25519PrivateKey.generate()
    both = (ed25519.public_half(key), ed25519.public_half(fresh))
    checks = ResumeVerifier(["arm-1"], lambda: both, lambda: clock.wall, lambda: clock.steady)
    assert checks.check(one(key, clock), [EPOCH]) == Admitted(EPOCH)
    assert checks.check(one(fresh, clock), [EPOCH]) == Admitted(EPOCH)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"v": 2}, Denial.VERSION),
        ({"v": True}, Denial.VERSION),
        ({"v": 1.0}, Denial.VERSION),
        ({"epoch": EPOCH.upper()}, Denial.SHAPES),
        ({"epoch": 7}, Denial.SHAPES),
        ({"targets": []}, Denial.SHAPES),
        ({"targets": "arm-1"}, Denial.SHAPES),
        ({"targets": ["b", "a"]}, Denial.SHAPES),
        ({"targets": ["arm-1", "arm-1"]}, Denial.SHAPES),
        ({"targets": ["arm-1", "*"]}, Denial.SHAPES),
        ({"targets": [f"arm-{n:03d}" for n in range(257)]}, Denial.SHAPES),
        ({"t": True}, Denial.SHAPES),
        ({"t": "now"}, Denial.SHAPES),
        ({"t": 10**400}, Denial.SHAPES),
        ({"nonce": "c" * 31}, Denial.SHAPES),
        ({"targets": ["arm-2"]}, Denial.TARGETS),
        ({"epoch": "c" * 32}, Denial.EPOCH),
        ({"t": NOW - 60.0}, Denial.STALE),
        ({"t": NOW + 5.0}, Denial.STALE),
    ],
)
def test_each_check_has_a_reason_of_its_own(key: Any, clock: Clock, change: dict[str, Any], why: Denial) -> None:
    assert verifier(key, clock).check(resigned(key, one(key, clock), **change), [EPOCH]) is why


@pytest.mark.parametrize("change", [{"t": NOW - 59.9}, {"t": NOW + 4.9}, {"t": int(NOW)}])
def test_the_edges_of_freshness_are_admitted(key: Any, clock: Clock, change: dict[str, Any]) -> None:
    assert verifier(key, clock).check(resigned(key, one(key, clock), **change), [EPOCH]) == Admitted(EPOCH)


def test_without_a_public_key_nothing_is_admitted(key: Any, clock: Clock) -> None:
    assert verifier(None, clock).check(one(key, clock), [EPOCH]) is Denial.NO_KEYS


def test_a_robot_that_holds_nothing_has_nothing_to_resume(key: Any, clock: Clock) -> None:
    assert verifier(key, clock).check(one(key, clock), []) is Denial.NOT_LOCKED


@pytest.mark.parametrize("thing", [None, [], "resume", 3])
def test_what_is_no_object_is_refused(key: Any, clock: Clock, thing: object) -> None:
    assert verifier(key, clock).check(thing, [EPOCH]) is Denial.NO_OBJECT


def test_a_field_more_or_less_is_refused(key: Any, clock: Clock) -> None:
    checks, assertion = verifier(key, clock), one(key, clock)
    assert checks.check({**assertion, "extra": 1}, [EPOCH]) is Denial.FIELDS
    assertion.pop("nonce")
    assert checks.check(assertion, [EPOCH]) is Denial.FIELDS


@pytest.mark.parametrize("sig", ["", "=" * 88, "A" * 86, "A" * 200, 7, None, "é" * 86])
def test_a_signature_that_is_none_is_refused(key: Any, clock: Clock, sig: object) -> None:
    answer = verifier(key, clock).check({**one(key, clock), "sig": sig}, [EPOCH])
    assert answer in (Denial.SHAPES, Denial.SIGNATURE)


def test_a_wrong_key_and_a_tampered_target_list_are_refused(key: Any, clock: Clock) -> None:
    checks = verifier(key, clock)
    assert checks.check(one(Ed25519PrivateKey.generate(), clock), [EPOCH]) is Denial.SIGNATURE
    tampered = {**one(key, clock, "arm-2"), "targets": ["arm-1"]}
    assert checks.check(tampered, [EPOCH]) is Denial.SIGNATURE


def test_a_nonce_serves_once_even_after_a_second_stop(key: Any, clock: Clock) -> None:
    checks, assertion = verifier(key, clock), one(key, clock)
    assert checks.check(assertion, [EPOCH]) == Admitted(EPOCH)
    assert checks.check(assertion, [EPOCH]) is Denial.NONCE


def test_five_refusals_close_the_door_for_thirty_seconds_to_a_good_one_too(key: Any, clock: Clock) -> None:
    checks = verifier(key, clock)
    for _ in range(5):
        assert checks.check({}, [EPOCH]) is Denial.FIELDS
    assert checks.check(one(key, clock), [EPOCH]) is Denial.BACKING_OFF
    clock.move(BACK_OFF_S - 0.1)
    assert checks.check(one(key, clock), [EPOCH]) is Denial.BACKING_OFF
    clock.move(0.2)
    assert checks.check(one(key, clock), [EPOCH]) == Admitted(EPOCH)


def test_a_good_resume_forgives_the_refusals_before_it(key: Any, clock: Clock) -> None:
    checks = verifier(key, clock)
    for _ in range(3):
        for _ in range(4):
            assert checks.check({}, [EPOCH]) is Denial.FIELDS
        assert checks.check(one(key, clock), [EPOCH]) == Admitted(EPOCH)


def test_a_long_target_list_is_split_and_every_part_fits_the_wire(key: Any, clock: Clock) -> None:
    names = [f"{n:04d}{'x' * 124}" for n in range(300)]
    assertions = sign(key, EPOCH, names, clock=lambda: clock.wall)
    assert all(len(json.dumps(each)) <= ASSERTION_MAX_BYTES for each in assertions)
    assert sorted(name for each in assertions for name in each["targets"]) == sorted(names)
    assert verifier(key, clock, names[-1]).check(assertions[-1], [EPOCH]) == Admitted(EPOCH)
    short = sign(key, EPOCH, [f"{n}" for n in range(1000)])
    assert all(len(each["targets"]) <= 256 for each in short)


def test_a_resume_for_nobody_or_for_no_epoch_is_refused_by_name(key: Any) -> None:
    with pytest.raises(ValidationError, match="targets"):
        sign(key, EPOCH, [])
    with pytest.raises(ValidationError, match="epoch"):
        sign(key, "overflow", ["arm-1"])
    with pytest.raises(ValidationError, match="target"):
        sign(key, EPOCH, ["arm/1"])


def test_a_made_key_signs_after_it_was_loaded(tmp_path: Path, clock: Clock) -> None:
    path = tmp_path / "operator.pem"
    public = ed25519.keygen(path, GOOD)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert b"ENCRYPTED" in path.read_bytes()
    key = ed25519.load_signing_key(path, GOOD)
    assert ed25519.encode(ed25519.public_half(key)) == public
    assert verifier(key, clock).check(one(key, clock), [EPOCH]) == Admitted(EPOCH)


def test_a_key_file_is_never_written_over(tmp_path: Path) -> None:
    path = tmp_path / "operator.pem"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        ed25519.keygen(path, GOOD)
    link = tmp_path / "link.pem"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(FileExistsError):
        ed25519.keygen(link, GOOD)
    assert path.read_text() == "mine"


@pytest.mark.parametrize("weak", ["", "Short-7-Pass", "correct horse battery", "Aa1-Aa1-Aa1-Aa1-Aa1"])
def test_a_weak_passphrase_is_refused(tmp_path: Path, weak: str) -> None:
    with pytest.raises(ValidationError, match="passphrase"):
        ed25519.keygen(tmp_path / "operator.pem", weak)
    assert not (tmp_path / "operator.pem").exists()


def test_a_wrong_passphrase_no_key_and_another_kind_are_value_errors(tmp_path: Path) -> None:
    path = tmp_path / "operator.pem"
    ed25519.keygen(path, GOOD)
    with pytest.raises(ValueError, match="passphrase"):
        ed25519.load_signing_key(path, GOOD + "x")
    path.write_text("no key")
    with pytest.raises(ValueError, match="no private key"):
        ed25519.load_signing_key(path, GOOD)
    other = X25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(GOOD.encode()),
    )
    path.write_bytes(other)
    with pytest.raises(ValueError, match="another kind"):
        ed25519.load_signing_key(path, GOOD)


def test_public_keys_come_from_a_comma_list_and_a_bad_word_is_named(
    key: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    word = ed25519.encode(ed25519.public_half(key))
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", f" {word} , nonsense,{word.rstrip('=')}")
    assert configured_keys() == (ed25519.public_half(key),) * 2
    assert "nonsense" in caplog.text
