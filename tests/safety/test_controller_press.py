"""One press is one stop: its id and its time stay the same however often it is sent."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.estop_orders import order_of

from strands_robots.safety import ed25519
from strands_robots.safety.answers import PRESSES_MAX
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.orders import StopOrder, StopRules, new_epoch
from strands_robots.safety.stop_link import ESTOP, VERDICT, notification


class PatchyLink:
    """Down for the first ``lost`` sendings, then up; a robot answers each sending that leaves."""

    def __init__(self, lost: int = 0) -> None:
        self.up, self._lost = True, lost
        self.sent: list[bytes] = []
        self.hear: Callable[[str, str, bytes], None] = lambda event, source, payload: None

    def open(self, events: object, hear: Callable[[str, str, bytes], None], on_state: object) -> None:
        self.hear = hear

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        if event != ESTOP:
            return True
        self.sent.append(payload)
        if len(self.sent) <= self._lost:
            return False
        answer = {"device_id": "arm-1", "estop_id": self.params[-1]["estop_id"], "stopped": True}
        self.hear(VERDICT, "arm-1", notification(VERDICT, answer))
        return True

    @property
    def params(self) -> list[dict[str, Any]]:
        return [json.loads(each)["params"] for each in self.sent]

    def close(self) -> None:
        self.up = False


def test_every_sending_has_the_id_and_the_press_of_the_first_and_a_time_of_its_own() -> None:
    key, link = Ed25519PrivateKey.generate(), PatchyLink(lost=3)
    rules = StopRules(allow=(), keys=(ed25519.public_half(key),))
    report = SafetyController("safety-1", lambda: link, signing_key=key).stop(["arm-1"], "smoke", deadline_s=20)
    assert report.ok
    assert len(link.sent) == 4
    assert len({each["estop_id"] for each in link.params}) == len({each["pressed_at"] for each in link.params}) == 1
    times = [each["t"] for each in link.params]
    assert times == sorted(set(times))
    assert len({each["nonce"] for each in link.params}) == 4
    for payload in link.sent:
        order = order_of(rules, "safety-1", payload)
        assert isinstance(order, StopOrder)
        assert order.pressed == link.params[0]["pressed_at"]


def test_a_stop_that_goes_on_under_its_id_keeps_the_time_of_its_press() -> None:
    link, estop_id = PatchyLink(lost=10**6), new_epoch()
    controller = SafetyController("safety-1", lambda: link)
    controller.stop(["arm-1"], deadline_s=0.05, estop_id=estop_id)
    controller.stop(["arm-1"], deadline_s=0.05, estop_id=estop_id)
    assert len({each["pressed_at"] for each in link.params}) == 1
    controller.stop(["arm-1"], deadline_s=0.05)
    assert len({each["pressed_at"] for each in link.params}) == 2


def test_times_count_from_the_press_and_say_when_the_stop_left() -> None:
    link, estop_id = PatchyLink(lost=2), new_epoch()
    controller = SafetyController("safety-1", lambda: link)
    press = controller.press(estop_id)
    time.sleep(0.05)  # the time that the report must hold
    report = controller.stop(["arm-1"], deadline_s=20, estop_id=estop_id)
    assert link.params[0]["pressed_at"] == press.wall <= link.params[0]["t"] - 0.04
    assert 50 <= report.left_ms <= report.stopped["arm-1"].latency_ms <= report.elapsed_ms


def test_presses_are_remembered_in_bounds() -> None:
    controller = SafetyController("safety-1", PatchyLink)
    first = controller.press("0" * 32)
    for number in range(1, PRESSES_MAX + 2):
        controller.press(f"{number:032x}")
    assert controller.press("0" * 32) != first


def test_a_signed_stop_is_repeated_often_in_its_first_half_second() -> None:
    bare, signed = PatchyLink(lost=10**6), PatchyLink(lost=10**6)
    SafetyController("safety-1", lambda: bare).stop(["arm-1"], deadline_s=0.5)
    key = Ed25519PrivateKey.generate()
    SafetyController("safety-1", lambda: signed, signing_key=key).stop(["arm-1"], deadline_s=0.5)
    assert len(bare.sent) <= 10 < len(signed.sent)


def test_an_answer_that_arrives_after_the_controller_returned_is_in_its_review() -> None:
    link = PatchyLink()
    controller = SafetyController("safety-1", lambda: link)
    report = controller.stop(["arm-1"], deadline_s=20)
    assert report.ok
    assert controller.review(report) is report
    late = {"device_id": "arm-1", "estop_id": report.estop_id, "stopped": False, "not_stopped": {"arm-1": "it moved"}}
    link.hear(VERDICT, "stranger", notification(VERDICT, {**late, "device_id": "stranger"}))
    link.hear(VERDICT, "arm-1", notification(VERDICT, late))
    reviewed = controller.review(report)
    assert not reviewed.ok
    assert reviewed.not_stopped.keys() == {"arm-1"}
    assert reviewed.not_stopped["arm-1"].why == "arm-1: it moved"
    assert reviewed.elapsed_ms == report.elapsed_ms
    assert controller.review(reviewed) is reviewed


def test_only_the_latest_stop_is_reviewed() -> None:
    link = PatchyLink()
    controller = SafetyController("safety-1", lambda: link)
    first = controller.stop(["arm-1"], deadline_s=20)
    controller.stop(["arm-1"], deadline_s=20)
    link.hear(VERDICT, "arm-1", notification(VERDICT, {"estop_id": first.estop_id, "stopped": False}))
    assert controller.review(first) is first
