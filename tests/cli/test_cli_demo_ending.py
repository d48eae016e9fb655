"""The demo's ending, with an agent and a controller that do what the test says: what did not happen must fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from strands_robots.audit import flush_audit, log_safety_event
from strands_robots.cli.demo.ending import Ending
from strands_robots.cli.demo.show import Show
from strands_robots.cli.demo.story import Report
from strands_robots.cli.output import Failure, Screen
from strands_robots.safety.controller import Answer, StopReport

EPOCH = "0123456789abcdef0123456789abcdef"


class Scene:
    """A robot and a controller that behave; a test spoils one thing."""

    def __init__(self) -> None:
        answer = Answer("arm-1", True, 3.0, "")
        self.told = StopReport(EPOCH, {"arm-1": answer}, {}, {}, (), True, 3.0)
        self.refusal: dict[str, Any] = {"status": "error", "reason": f"locked by demo-safety, epoch {EPOCH}"}
        self.resumed: dict[str, Any] = {"locked": False, "epochs": []}
        self.status: dict[str, Any] = {"locked": False, "running_policies": {}}
        self.runs = True
        self.records = 2
        self.assertions: list[Any] = []
        self.report = Report()

    def stop(self, expected: list[str], reason: str, *, deadline_s: float) -> StopReport:
        return self.told

    def ask(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        return self.refusal

    def call(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        if function == "resume":
            self.assertions.append(params["assertion"])
            return self.resumed
        return self.status

    @contextmanager
    def events(self, device_id: str) -> Iterator[None]:
        yield None

    def set_off(self, stream: None, title: str, seconds: float) -> None:
        pass

    def rest(self, stream: None) -> tuple[float, float]:
        return 0.01, 0.0

    def to_the_end(self, stream: None, title: str, seconds: float) -> tuple[int, float]:
        if not self.runs:
            raise Failure("The motion did not report its end.")
        return 100, 1.0


def tell(scene: Scene) -> None:
    for number in range(scene.records):
        log_safety_event("emergency_stop", "arm-1", {"number": number})
    assert flush_audit(20)
    spot: Any = scene
    ending = Ending(
        Show(Screen(machine=True)), spot, spot, peer_id="arm-1", controller=spot, key=Ed25519PrivateKey.generate()
    )
    for step in ending.steps:
        step()


def test_an_ending_in_which_everything_happens_passes() -> None:
    scene = Scene()
    tell(scene)
    assert [(step["step"], step["ok"]) for step in scene.report.steps] == [
        ("emergency stop", True),
        ("refusal", True),
        ("resume", True),
        ("execute again", True),
    ]
    assert [(each["epoch"], each["targets"]) for each in scene.assertions] == [(EPOCH, ["arm-1"])]


SPOILED: dict[str, tuple[Callable[[Scene], None], str]] = {
    "an answer": (
        lambda scene: setattr(scene, "told", StopReport(EPOCH, {}, {}, {}, ("arm-1",), True, 3000.0)),
        "did not answer the emergency stop",
    ),
    "a refusal": (lambda scene: setattr(scene, "refusal", {"status": "success"}), "did not refuse a motion"),
    "its stop's name": (
        lambda scene: setattr(scene, "refusal", {"status": "error", "reason": "busy"}),
        "did not refuse a motion",
    ),
    "who stopped": (
        lambda scene: setattr(scene, "refusal", {"status": "error", "reason": EPOCH}),
        "does not say who",
    ),
    "a resume": (lambda scene: scene.resumed.update(locked=True), "still locked"),
    "freedom": (lambda scene: scene.status.update(locked=True), "still locked"),
    "stillness": (lambda scene: scene.status.update(running_policies={"so100": {}}), "started a motion"),
    "a motion": (lambda scene: setattr(scene, "runs", False), "did not report its end"),
    "a record": (lambda scene: setattr(scene, "records", 0), "does not tell what happened"),
}


@pytest.mark.parametrize("missing", SPOILED)
def test_an_ending_without_one_part_fails_the_demo(missing: str) -> None:
    spoil, said = SPOILED[missing]
    scene = Scene()
    spoil(scene)
    with pytest.raises(Failure, match=said):
        tell(scene)
