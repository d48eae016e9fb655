"""The rules by which an emergency stop counts: its source, its signature, and nothing else."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.estop_orders import order_of
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.safety import ed25519
from strands_robots.safety.orders import PARSED_MAX_BYTES, StopOrder, StopRefused, StopRules, new_epoch, signed_bytes
from strands_robots.safety.statements import Purpose

OPEN = StopRules(allow=(), keys=())


def event(**params: Any) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "method": "emergencyStop", "params": params}).encode()


def counted(answer: StopOrder | StopRefused) -> StopOrder:
    assert isinstance(answer, StopOrder), answer
    return answer


def test_a_stop_brings_its_epoch_reason_and_time() -> None:
    epoch = new_epoch()
    order = counted(order_of(OPEN, "safety-1", event(estop_id=epoch, reason="smoke", t=12.5)))
    assert (order.epoch, order.source, order.reason, order.issued) == (epoch, "safety-1", "smoke", 12.5)
    assert order.remote
    assert order.path == "lane"


def test_one_stop_by_two_paths_has_one_epoch() -> None:
    params = {"reason": "smoke", "event_id": "e-1"}
    listener, runtime = order_of(OPEN, "s", event(**params)), OPEN.order("s", params, "runtime")
    assert counted(listener).epoch == counted(runtime).epoch
    bare = {"reason": "smoke"}
    listener, runtime = order_of(OPEN, "s", event(**bare)), OPEN.order("s", bare, "runtime")
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
    order = counted(order_of(OPEN, "safety-1", payload))
    assert len(order.epoch) == 32
    assert order == counted(order_of(OPEN, "safety-1", payload, received=order.received))


@given(st.binary(max_size=300))
def test_whatever_the_bytes_a_source_that_may_stop_stops(payload: bytes) -> None:
    assert isinstance(order_of(OPEN, "safety-1", payload), StopOrder)


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
    assert isinstance(order_of(StopRules(allow=allow, keys=()), source, event()), StopOrder) is may


class Signer:
    def __init__(self) -> None:
        self.key = Ed25519PrivateKey.generate()
        self.public = ed25519.public_half(self.key)

    def params(
        self, source: str = "safety-1", purpose: Purpose = Purpose.EMERGENCY_STOP, **changes: Any
    ) -> dict[str, Any]:
        fields = {"estop_id": new_epoch(), "t": 12.5, "pressed_at": 12.0, "nonce": new_epoch(), "reason": "smoke"}
        message = signed_bytes(purpose, source, fields)
        return {**fields, "sig": ed25519.encode(self.key.sign(message)), **changes}


def test_with_keys_only_a_signed_stop_counts() -> None:
    signer = Signer()
    rules = StopRules(allow=(), keys=(Signer().public, signer.public))
    assert rules.signed
    assert isinstance(order_of(rules, "safety-1", event(**signer.params())), StopOrder)
    assert isinstance(order_of(rules, "safety-1", event(estop_id=new_epoch())), StopRefused)


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
        {"pressed_at": 11.0},
        {"pressed_at": None},
        {"reason": "fire"},
        {"reason": "x" * 300},
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


def test_a_check_in_that_was_recorded_is_no_emergency_stop() -> None:
    signer = Signer()
    rules = StopRules(allow=(), keys=(signer.public,))
    recorded = signer.params(purpose=Purpose.CHECK_IN)
    assert rules.signature_refusal("safety-1", recorded, Purpose.CHECK_IN) is None
    for renamed in (recorded, {**recorded, "purpose": "emergency-stop"}):
        refused = order_of(rules, "safety-1", event(**renamed))
        assert isinstance(refused, StopRefused)
        assert "emergency-stop" in refused.why


def test_an_emergency_stop_that_was_recorded_is_no_check_in() -> None:
    signer = Signer()
    rules = StopRules(allow=(), keys=(signer.public,))
    assert rules.signature_refusal("safety-1", signer.params(), Purpose.CHECK_IN) is not None


def stop_at(sent: float, pressed: float | None, **more: Any) -> StopOrder:
    return StopOrder(new_epoch(), "safety-1", issued=sent, pressed=pressed, **more)


@pytest.mark.parametrize(
    ("sent", "pressed", "ahead", "received", "timing", "delay"),
    [
        (100.0, 100.0, None, 100.01, "on time", 0.0),
        (111.0, 100.0, None, 111.01, "late", 11.0),
        (101.2, 100.0, None, 101.2, "late", 1.2),
        (100.9, 100.0, 0.0, 101.2, "late", 1.2),
        (100.0, 100.0, 30.0, 130.2, "on time", 0.2),
        (100.0, 100.0, 30.0, 132.0, "late", 2.0),
        (100.0, 100.0, -30.0, 70.1, "on time", 0.1),
        (100.0, 100.0, None, 130.0, "on time", 0.0),
        (100.0, 100.0, None, 161.0, "late", 0.0),
        (100.0, 100.0, None, 90.0, "ahead", 0.0),
        (100.0, 105.0, None, 100.0, "on time", 0.0),
        (100.0, None, 0.0, 111.0, "on time", None),
        (100.0, None, 0.0, 161.0, "late", None),
    ],
)
def test_a_stop_is_late_by_the_time_since_its_press_whatever_the_clocks(
    sent: float, pressed: float | None, ahead: float | None, received: float, timing: str, delay: float | None
) -> None:
    order = stop_at(sent, pressed, clock_ahead_s=ahead)
    assert order.timing(received) == timing
    assert order.delay_s(received) == (delay if delay is None else pytest.approx(delay))


def test_clocks_are_compared_by_the_messages_of_a_source_that_counts() -> None:
    now = 1000.0
    rules = StopRules(allow=(), keys=(), clock=lambda: now)
    rules.compare_clock("safety-1", {"t": 970.0}, time.monotonic())
    order = counted(order_of(rules, "safety-1", event(estop_id=new_epoch(), t=969.0, pressed_at=968.5)))
    assert order.clock_ahead_s == pytest.approx(30.0, abs=0.1)
    assert order.delay_s(order.received_at) == pytest.approx(1.5, abs=0.1)
    assert counted(order_of(rules, "safety-2", event(t=969.0))).clock_ahead_s is None


def test_a_mistyped_key_leaves_the_fleet_stoppable_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", "oops")
    assert isinstance(order_of(StopRules(), "safety-1", event()), StopOrder)
    assert "oops" in caplog.text


def test_stop_that_is_too_long_to_be_read_stops_with_a_fresh_epoch_each_quarter_of_a_second() -> None:
    rules = StopRules(allow=["safety-*"], keys=())
    orders = [rules.order("safety-1", {}, "lane", 8_000_000, received=10.0 + after) for after in (0.0, 0.2, 0.3)]
    other = rules.order("safety-2", {}, "runtime", 8_000_000, received=10.0)
    assert all(isinstance(each, StopOrder) for each in (*orders, other))
    epochs = [each.epoch for each in (*orders, other) if isinstance(each, StopOrder)]
    assert epochs[0] == epochs[1]
    assert len(set(epochs)) == 3
    assert orders[0].reason == "an emergency stop of 8000000 bytes, which was not read"
    for number in range(1000):
        rules.order(f"safety-{number}", {}, "lane", 8_000_000)


def test_stop_that_is_too_long_to_be_read_is_refused_where_it_has_to_be_signed() -> None:
    public = ed25519.public_half(Ed25519PrivateKey.generate())
    for rules in (StopRules(allow=(), keys=[public]), StopRules(allow=["other"], keys=())):
        assert isinstance(rules.order("safety-1", {}, "lane", 8_000_000), StopRefused)


def test_each_press_of_a_panel_that_always_sends_the_same_bytes_is_a_stop_of_its_own() -> None:
    rules = StopRules(allow=(), keys=())
    orders = [rules.order("panel", {"reason": "press"}, "listener", b"STOP", at) for at in (0.0, 0.1, 10.0, 20.0)]
    first, repeated, second, third = (each.epoch for each in orders if isinstance(each, StopOrder))
    assert first == repeated
    assert len({first, second, third}) == 3
