"""The screen of the safety controller: robots and links of every network, and what came of a press."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator

import pytest
from fixtures.waiting import eventually
from rich.console import Console
from tests.fleet.scripted import ScriptedNetwork
from tests.fleet.scripted_sender import ScriptedSender

from strands_robots.cli import safety_controller
from strands_robots.cli.safety_controller import ConsoleScreen
from strands_robots.cli.stop import style_of
from strands_robots.fleet import joining, safety_console
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, LockoutReport
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.safety_console import SafetyConsole, WatchedRobots
from strands_robots.safety.answers import Answer, Progress
from strands_robots.safety.lockout import Lockout


class Turning:
    """A monotonic clock that the test turns."""

    now = 1000.0

    def monotonic(self) -> float:
        """Return its seconds."""
        return self.now


@pytest.fixture
def sender() -> ScriptedSender:
    return ScriptedSender()


@pytest.fixture
def near(sender: ScriptedSender) -> ScriptedNetwork:
    """A network whose stops have a connection of their own."""
    network = ScriptedNetwork(DEVICE_CONNECT, {})
    network.controller, network.has_stop_link = sender, True
    return network


@pytest.fixture
def far() -> ScriptedNetwork:
    """A network whose stops need it to be joined."""
    network = ScriptedNetwork(MESH, {})
    network.controller = ScriptedSender()
    return network


@pytest.fixture(autouse=True)
def seldom_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test says itself what robots report, and a network that is not there is tried again at once."""
    monkeypatch.setattr(safety_console, "LOOK_S", 3600.0)
    monkeypatch.setattr(joining, "AGAIN_S", 0.01)


@pytest.fixture
def console(near: ScriptedNetwork) -> Iterator[SafetyConsole]:
    console = SafetyConsole(Networks([near], stays=True), reason="test")
    console.open()
    yield console
    console.close()


@pytest.fixture
def both(near: ScriptedNetwork, far: ScriptedNetwork) -> Iterator[SafetyConsole]:
    console = SafetyConsole(Networks([near, far], stays=True), reason="test", check_in_s=0.5)
    console.open()
    yield console
    console.close()


def robots(console: SafetyConsole, network: str = DEVICE_CONNECT) -> WatchedRobots:
    return console.watched[network]


def test_screen_says_how_long_ago_a_stop_was_pressed(console: SafetyConsole, sender: ScriptedSender) -> None:
    robots(console).update([LockoutReport("arm-1")])
    sender.answer.clear()
    console.press()
    (button,) = console.buttons.latest.values()
    button.progress = Progress("e" * 32, {}, ("arm-1",), False, 6600.0)
    assert "STOPPING, pressed 6.6 s ago: 0 answered" in drawn(console)
    sender.answer.set()
    eventually(lambda: not console.buttons.running)
    button.progress = Progress("e" * 32, {"arm-1": Answer("arm-1", True, 11_021.0, "")}, (), True, 11_021.0, 11_000.0)
    assert "stopped 11.0 s after the press" in drawn(console)


def test_screen_turns_red_when_a_robot_says_later_that_it_did_not_stop(
    console: SafetyConsole, sender: ScriptedSender
) -> None:
    robots(console).update([LockoutReport("arm-1")])
    sender.stopped = {"arm-1": Answer("arm-1", True, 8.0, "")}
    console.press()
    eventually(lambda: not console.buttons.running)
    console.buttons.review()
    assert "stopped in 8.0 ms" in drawn(console)
    sender.late = {"arm-1": Answer("arm-1", False, 4000.0, "arm-1: it moved")}
    console.buttons.review()
    (button,) = console.buttons.latest.values()
    assert button.report is not None
    assert style_of(button.report) == "bold red"
    assert "1 DID NOT STOP" in drawn(console)
    assert "stopped in 8.0 ms" not in drawn(console)


def drawn(console: SafetyConsole, check_in_s: float | None = None) -> str:
    out = Console(file=io.StringIO(), width=160, height=40)
    out.print(ConsoleScreen(console, "safety-1", check_in_s).draw(["ERROR something"]))
    output: str = out.file.getvalue()  # type: ignore[attr-defined]  # it is a StringIO
    return output


def test_screen_shows_lockouts_check_ins_and_gone_robots(
    console: SafetyConsole, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = robots(console)
    hold = Lockout("e" * 32, "desk-1", "a hand", 0.0)
    checked = {"check_in": {"required": True, "timeout_s": 2.0, "time_left_s": 1.25}}
    fleet.update(
        [
            LockoutReport("arm-1", (hold,)),
            LockoutReport("arm-2", facts=checked),
            LockoutReport("arm-9", problem="no answer"),
        ]
    )
    output = drawn(console, 0.5)
    assert "safety-1: the stop link is up; checks in every 0.5 s" in output
    assert "LOCKED" in output and "desk-1 a hand" in output
    assert "1.2 s left" in output
    assert "arm-9" not in output
    assert "SPACE stops everything" in output and "ERROR something" in output
    monkeypatch.setattr(safety_controller, "GONE_S", 0.0)
    monkeypatch.setattr(safety_console, "GONE_S", 0.0)
    fleet.update([LockoutReport("arm-1", problem="no answer")])
    assert "GONE" in drawn(console)
    assert set(fleet.expected()) == {"arm-1", "arm-2"}
    console.forget()
    assert fleet.expected() == ()


def test_age_of_a_lockouts_report_is_shown_beside_a_fresh_beat(
    console: SafetyConsole, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet, clock = robots(console), Turning()
    for each in (safety_controller, safety_console):
        monkeypatch.setattr(each, "time", clock)
    fleet.take_beats({"arm-0": clock.now})
    fleet.update([LockoutReport("arm-0", at=clock.now)])
    assert "s ago" not in drawn(console).replace("0 s ago", "")
    clock.now += 7.0
    fleet.take_beats({"arm-0": clock.now})
    assert "free, 7 s ago" in drawn(console)
    assert "NO ANSWER" not in drawn(console)
    fleet.update([LockoutReport("arm-0", problem="no answer")])
    assert "beats, NO ANSWER for 7 s" in drawn(console)
    fleet.update([LockoutReport("arm-0", at=clock.now)])
    assert "NO ANSWER" not in drawn(console)


def test_a_robot_that_beats_is_not_gone_though_its_status_is_old(console: SafetyConsole) -> None:
    fleet = robots(console)
    fleet.update([LockoutReport("arm-1", at=time.monotonic() - 100.0)])
    assert "GONE" in drawn(console)
    fleet.take_beats({"arm-1": time.monotonic() + 1000.0})
    assert "GONE" not in drawn(console)
    fleet.forget()
    assert fleet.expected() == ("arm-1",)


def test_screen_of_two_networks_names_each_robots_and_each_link(both: SafetyConsole, far: ScriptedNetwork) -> None:
    eventually(lambda: len(both.watched) == 2)
    robots(both).update([LockoutReport("arm-1"), LockoutReport("both")])
    robots(both, MESH).update([LockoutReport("arm-2"), LockoutReport("both")])
    output = drawn(both, 0.5)
    assert "the stop link is up on device_connect, up on mesh; checks in every 0.5 s" in output
    # Robots that state no cell stop always.
    rows = [line.split() for line in output.splitlines() if " free " in line]
    assert [(row[0], row[3]) for row in rows] == [
        ("arm-1,", "device_connect"),
        ("arm-2,", "mesh"),
        ("both,", "device_connect"),
        ("both,", "mesh"),
    ]
    far.controller.link_up = False
    assert "up on device_connect, DOWN on mesh" in drawn(both)
    assert far.controller.check_ins == [0.5]


def test_press_goes_to_both_networks_and_a_stop_of_one_robot_to_those_that_have_it(
    both: SafetyConsole, sender: ScriptedSender, far: ScriptedNetwork
) -> None:
    eventually(lambda: len(both.watched) == 2)
    robots(both).update([LockoutReport("arm-1"), LockoutReport("both")])
    robots(both, MESH).update([LockoutReport("arm-2"), LockoutReport("both")])
    both.press()
    eventually(lambda: not both.buttons.running)
    assert sender.ids == far.controller.ids
    screen = ConsoleScreen(both, "safety-1", None)
    for name, near, there in (("arm-1", 1, 0), ("arm-2", 0, 1), ("both", 1, 1)):
        sender.scopes.clear()
        far.controller.scopes.clear()
        screen.choose(1)
        both.press(screen.chosen_scope(cell=False))
        eventually(lambda: not both.buttons.running)
        assert (len(sender.scopes), len(far.controller.scopes)) == (near, there), name


def test_network_that_is_not_there_is_named_and_gets_its_button_when_it_comes(
    both: SafetyConsole, near: ScriptedNetwork, far: ScriptedNetwork, sender: ScriptedSender
) -> None:
    both.close()
    far.unreachable = "no hub"
    console = SafetyConsole(Networks([near, far], stays=True))
    console.open()
    try:
        eventually(lambda: "mesh: no hub" in drawn(console))
        assert "up on device_connect, DOWN on mesh" in drawn(console)
        console.press()
        eventually(lambda: not console.buttons.running)
        assert (len(sender.ids), far.controller.ids) == (1, [])
        far.unreachable = ""
        eventually(lambda: far.controller.ids == sender.ids)
        assert "up on device_connect, up on mesh" in drawn(console)
    finally:
        console.close()


def test_network_to_which_nobody_is_connected_is_no_alarm_beside_another(
    both: SafetyConsole, sender: ScriptedSender, far: ScriptedNetwork
) -> None:
    eventually(lambda: len(both.watched) == 2)
    sender.link_up = False
    assert "safety-1: the stop link is up\n" in drawn(both).replace(" \n", "\n")
    robots(both).update([LockoutReport("arm-1")])
    assert "DOWN on device_connect, up on mesh" in drawn(both)


def test_network_that_cannot_stand_takes_no_button_from_the_other(
    near: ScriptedNetwork, far: ScriptedNetwork, sender: ScriptedSender, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(near, "standing", None)
    console = SafetyConsole(Networks([near, far], stays=True))
    console.open()
    try:
        eventually(lambda: bool(console.watched))
        console.press()
        eventually(lambda: len(far.controller.ids) == 1)
        assert "device_connect: TypeError" in drawn(console)
    finally:
        console.close()
