from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from click.testing import Result

from strands_robots.cli import fleet
from strands_robots.cli.fleet import verdict
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.client import CallRefusedError, DeviceTimeoutError, NoSuchDeviceError, Peer
from strands_robots.envelope import Envelope, error, success

Run = Callable[..., Result]


class FakeFleet:
    """A fleet that answers what the test says."""

    def __init__(self) -> None:
        self.link = loopback_config()
        self.found: list[Peer] = []
        self.answer: Envelope | Exception = success("done")
        self.stops: dict[str, Envelope] = {}
        self.called: list[tuple[Any, ...]] = []

    def peers(self, timeout: float = 2.0) -> list[Peer]:
        return self.found

    def call(self, *called: Any) -> Envelope:
        self.called.append(called)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def stop(self, device: str, timeout: float) -> Envelope:
        return self.stops[device]

    def stop_all(self, timeout: float) -> dict[str, Envelope]:
        return self.stops


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeFleet:
    there = FakeFleet()

    @contextmanager
    def reached(network: object, source: str = "") -> Iterator[FakeFleet]:
        yield there

    monkeypatch.setattr(fleet, "reached", reached)
    return there


def arm(name: str = "arm-1") -> Peer:
    execute = {
        "name": "execute",
        "description": "Start a policy.\nAnd more.",
        "parameters": {"properties": {"instruction": {"type": "string"}}},
    }
    return Peer(name, "strands_sim", "so100", {"availability": "idle"}, (execute, {"name": "stop"}), ("stateUpdate",))


def test_peers_are_listed_for_people_and_for_programs(run: Run, fake: FakeFleet) -> None:
    fake.found = [arm()]
    assert "arm-1" in run("peers").stdout
    assert json.loads(run("peers", "--json").stdout)["peers"][0]["id"] == "arm-1"
    shown = run("peers", "arm-1").stdout
    assert "instruction: string" in shown
    assert "Start a policy." in shown
    assert "And more" not in shown


def test_a_peer_cannot_write_to_the_terminal(run: Run, fake: FakeFleet) -> None:
    fake.found = [Peer("arm-1", "[bold]\x1b]0;owned\x07", "\u202emodel", {"availability": "[red]x"})]
    shown = run("peers").stdout
    assert "\x1b" not in shown and "\x07" not in shown and "\u202e" not in shown
    assert "[bold]" in shown


@pytest.mark.parametrize("words", [("peers",), ("peers", "arm-2"), ("stop", "--all")])
def test_nobody_there_is_exit_3(run: Run, fake: FakeFleet, words: tuple[str, ...]) -> None:
    assert run(*words).exit_code == 3
    assert json.loads(run(*words, "--json").stdout)["exit"] == 3


def test_a_call_sends_typed_values(run: Run, fake: FakeFleet) -> None:
    result = run("call", "arm-1", "execute", "instruction=wave", "duration=2", "--timeout", "4")
    assert result.exit_code == 0
    assert fake.called == [("arm-1", "execute", {"instruction": "wave", "duration": 2}, 4.0)]


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        (error("not allowed"), 1),
        (CallRefusedError("Unknown method: x", -32601), 1),
        (NoSuchDeviceError("No device 'arm-1' in tenant 'default'."), 3),
        (DeviceTimeoutError("arm-1 is announced and did not answer within 4 s."), 3),
    ],
)
def test_a_call_that_fails_says_why_and_exits_accordingly(
    run: Run, fake: FakeFleet, answer: Envelope | Exception, code: int
) -> None:
    fake.answer = answer
    result = run("call", "arm-1", "execute", "--json")
    assert result.exit_code == code
    said = json.loads(result.stdout)
    assert said["status"] == "error"
    assert said["reason"]
    assert run("call", "arm-1", "execute").stdout == ""


@pytest.mark.parametrize("words", [("a=1", "a=2"), ("nothing",), ("x=NaN",), ("--timeout", "0"), ("--timeout", "nan")])
def test_a_call_with_wrong_words_is_exit_2_and_sends_nothing(run: Run, fake: FakeFleet, words: tuple[str, ...]) -> None:
    assert run("call", "arm-1", "execute", *words).exit_code == 2
    assert fake.called == []


def test_stop_tells_each_verdict_and_the_worst_decides(run: Run, fake: FakeFleet) -> None:
    fake.stops = {"a": success("Stopped.", stopped=True)}
    assert run("stop", "a").exit_code == 0
    fake.stops["b"] = error("no answer in 5 s", stopped=None)
    result = run("stop", "--all")
    assert result.exit_code == 3
    assert "silent" in result.stdout
    assert "b" in result.stderr
    fake.stops["c"] = error("the bus is wedged", stopped=False)
    result = run("stop", "--all", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["devices"]["c"] == {"stopped": False, "said": "the bus is wedged"}
    assert "DID NOT STOP" in run("stop", "--all").stdout


@pytest.mark.parametrize("words", [("stop",), ("stop", "a", "--all")])
def test_stop_takes_a_device_or_all(run: Run, fake: FakeFleet, words: tuple[str, ...]) -> None:
    assert run(*words).exit_code == 2


@pytest.mark.parametrize(
    ("answer", "stopped"),
    [
        (success("ok", stopped=True), True),
        (success("ok", stopped=["so100"], not_stopped=[]), True),
        (success("ok", stopped=False), False),
        (error("no"), False),
        (error("no", stopped=None), None),
        ({"result": 3}, None),
        (success("ok", not_stopped=["teleop"]), False),
    ],
)
def test_only_an_affirmative_answer_is_a_stop(answer: Envelope, stopped: bool | None) -> None:
    assert verdict(answer)[0] is stopped
