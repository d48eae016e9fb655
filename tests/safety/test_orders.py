"""The rules by which an emergency stop counts: its source, its signature, and nothing else."""

from __future__ import annotations

import json
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.safety import ed25519
from strands_robots.safety.orders import PARSED_MAX_BYTES, StopOrder, StopRefused, StopRules, new_epoch, signed_fields

OPEN = StopRules(allow=(), keys=())


def event(**params: Any) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "method": "emergencyStop", "params": params}).encode()


def counted(answer: StopOrder | StopRefused) -> StopOrder:
    assert isinstance(answer, StopOrder), answer
    return answer


def test_a_stop_brings_its_epoch_reason_and_time() -> None:
    epoch = new_epoch()
    order = counted(OPEN.order_of("safety-1", event(estop_id=epoch, reason="smoke", t=12.5)))
    assert (order.epoch, order.source, order.reason, order.issued) == (epoch, "safety-1", "smoke", 12.5)
    assert order.remote
    assert order.path == "lane"


def test_one_stop_by_two_paths_has_one_epoch() -> None:
    params = {"reason": "smoke", "event_id": "e-1"}
    listener, runtime = OPEN.order_of("s", event(**params)), OPEN.order("s", params, "runtime")
    assert counted(listener).epoch == counted(runtime).epoch
    bare = {"reason": "smoke"}
    listener, runtime = OPEN.order_of("s", event(**bare)), OPEN.order("s", bare, "runtime")
    assert counted(listener).epoch == counted(runtime).epoch


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff\xfe",
        b"[]",
        b"7",
        b'{"params": []}',
        b"[" * 100_000,
        b'{"params": {"t": NaN, "reason": 7, "estop_id": [1]}}',
        b'{"params": {"t": ' + b"9" * 5000 + b"}}",
        b"x" * (PARSED_MAX_BYTES + 1),
        event(t=True, reason="\x00"),
        event(t=10**300),
    ],
)
def test_no_shape_and_no_size_keeps_a_stop_from_counting(payload: bytes) -> None:
    order = counted(OPEN.order_of("safety-1", payload))
    assert len(order.epoch) == 32
    assert order == counted(OPEN.order_of("safety-1", payload, received=order.received))


@given(st.binary(max_size=300))
def test_whatever_the_bytes_a_source_that_may_stop_stops(payload: bytes) -> None:
    assert isinstance(OPEN.order_of("safety-1", payload), StopOrder)


@pytest.mark.parametrize(
    ("allow", "source", "may"),
    [
        ((), "anyone", True),
        (("safety-*",), "safety-1", True),
        (("safety-*",), "Safety-1", False),
        (("safety-1",), "safety-10", False),
        ((" ", ""), "anyone", True),
        ((), "", False),
        ((), " ", False),
    ],
)
def test_the_allowlist_decides_by_name(allow: tuple[str, ...], source: str, may: bool) -> None:
    assert isinstance(StopRules(allow=allow, keys=()).order_of(source, event()), StopOrder) is may


class Signer:
    def __init__(self) -> None:
        self.key = Ed25519PrivateKey.generate()
        self.public = ed25519.public_half(self.key)

    def params(self, source: str = "safety-1", **changes: Any) -> dict[str, Any]:
        fields = {"estop_id": new_epoch(), "t": 12.5, "nonce": new_epoch()}
        message = signed_fields(fields["estop_id"], source, fields["t"], fields["nonce"])
        return {**fields, "reason": "smoke", "sig": ed25519.encode(self.key.sign(message)), **changes}


def test_with_keys_only_a_signed_stop_counts() -> None:
    signer = Signer()
    rules = StopRules(allow=(), keys=(Signer().public, signer.public))
    assert rules.signed
    assert isinstance(rules.order_of("safety-1", event(**signer.params())), StopOrder)
    assert isinstance(rules.order_of("safety-1", event(estop_id=new_epoch())), StopRefused)


@pytest.mark.parametrize(
    "change",
    [
        {"estop_id": new_epoch()},
        {"t": 12.6},
        {"nonce": new_epoch()},
        {"sig": None},
        {"sig": "A" * 86},
        {"nonce": ""},
        {"t": None},
        {"t": True},
        {"t": 10**400},
    ],
)
def test_a_signature_over_anything_else_does_not_count(change: dict[str, Any]) -> None:
    signer = Signer()
    rules = StopRules(allow=(), keys=(signer.public,))
    assert isinstance(rules.order("safety-1", signer.params(**change), "lane"), StopRefused)


def test_a_signed_stop_of_another_source_does_not_count() -> None:
    signer = Signer()
    rules = StopRules(allow=(), keys=(signer.public,))
    assert isinstance(rules.order("safety-2", signer.params(), "lane"), StopRefused)


def test_a_mistyped_key_leaves_the_fleet_stoppable_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", "oops")
    assert isinstance(StopRules().order_of("safety-1", event()), StopOrder)
    assert "oops" in caplog.text
