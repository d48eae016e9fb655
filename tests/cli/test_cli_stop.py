from __future__ import annotations

import json
import shlex
import threading
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import pytest
from click.testing import Result
from device_connect_edge.messaging import MessagingError
from tests.cli.conftest import FakeFleet, Run

from strands_robots import device_connect
from strands_robots.audit import read_audit_log
from strands_robots.cli.network import Network
from strands_robots.cli.output import Exit, Screen
from strands_robots.cli.stop import exit_code, progress_rows, report_rows, show_resume, summary
from strands_robots.device_connect import safety_controller
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.backends.config import network_of
from strands_robots.device_connect.discovery import Peer, RegistryError
from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import StopRequest
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.verdicts import stop_outcome
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.roster import Sending
from strands_robots.safety.sightings import sightings


def answer(name: str, stopped: bool | None = True, ms: float = 3.0, why: str = "") -> Answer:
    return Answer(name, stopped, ms, why, {"halted": ["task"]} if stopped else {})


def report(*answers: Answer, silent: tuple[str, ...] = (), link: bool = True) -> StopReport:
    refused = {each.device_id: each for each in answers if "resumed before" in each.why}
    stopped = {each.device_id: each for each in answers if each.stopped}
    others = {each.device_id: each for each in answers if not each.stopped and each.device_id not in refused}
    return StopReport("e" * 32, stopped, others, refused, silent, link, 12.0)


class FakeController:
    """Answers every stop with one report."""

    def __init__(self, stop_report: StopReport) -> None:
        self.report = stop_report
        self.calls: list[tuple[list[str], str]] = []
        self.presses: list[str] = []
        self.sending, self.controller_id = Sending(), "desk"

    def wait_link(self, timeout: float) -> bool:
        return True

    def press(self, estop_id: str) -> None:
        self.presses.append(estop_id)

    def stop(self, expected: Collection[str], reason: str, **more: Any) -> StopReport:
        self.calls.append((list(expected), reason))
        return self.report

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        return True

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("stop_report", "code", "printed"),
    [
        (report(answer("a")), 0, "stopped"),
        (report(answer("a"), answer("b", False, why="bus: no answer in 1 s")), 1, "DID NOT STOP"),
        (report(answer("a"), answer("b", None, why="b: state unknown")), 1, "UNKNOWN"),
        (report(answer("a", None, why="a: this stop was resumed before it came again")), 1, "resumed before"),
        (report(answer("a"), silent=("b",)), 3, "NO ANSWER"),
        (report(), 3, "0 stopped"),
        (report(link=False, silent=("b",)), 3, "NO ANSWER"),
    ],
)
def test_estop_names_each_robot_and_exits_with_the_worst(
    run: Run, monkeypatch: pytest.MonkeyPatch, stop_report: StopReport, code: int, printed: str
) -> None:
    fake = FakeController(stop_report)
    monkeypatch.setattr(safety_controller, "safety_controller", lambda *given, **more: fake)
    names = sorted({*stop_report.answered, *stop_report.silent}) or ["a"]
    result = run("estop", *names, "--reason", "a hand")
    assert result.exit_code == code
    assert printed in result.stdout
    assert fake.calls == [(names, "a hand")]
    facts = json.loads(run("estop", *(names if stop_report.answered or stop_report.silent else []), "--json").stdout)
    assert facts["silent"] == list(stop_report.silent)
    assert (facts["status"] == "success") is (code == 0)


@pytest.mark.parametrize(
    ("stop_report", "locked"),
    [
        (report(answer("a", False, why="a verb has not returned")), True),
        (report(answer("a"), silent=("b",)), True),
        (report(silent=("a",)), False),
        (report(answer("a", None, why="a: this stop was resumed before it came again")), False),
    ],
)
def test_estop_that_failed_names_the_resume_of_the_robots_that_it_locked(
    run: Run, monkeypatch: pytest.MonkeyPatch, stop_report: StopReport, locked: bool
) -> None:
    monkeypatch.setattr(safety_controller, "safety_controller", lambda *given, **more: FakeController(stop_report))
    result = run("estop", *{*stop_report.answered, *stop_report.silent})
    assert result.exit_code != 0
    assert ("They are locked until" in result.stdout, "resume --local" in result.stdout) == (locked, locked)


@pytest.mark.parametrize("arguments", [("--as", ""), ("--key", "nowhere")])
def test_estop_with_wrong_arguments_is_exit_2(run: Run, arguments: tuple[str, ...]) -> None:
    assert run("estop", *arguments).exit_code == 2


@pytest.mark.parametrize(
    ("arguments", "expected", "said"),
    [
        (("a", "--all"), [], ""),
        (("a.b", "x" * 1000), ["a.b", "x" * 1000], ""),
        (("a", "--deadline", "0"), ["a"], "--deadline"),
        (("a", "--deadline", "nan"), ["a"], "--deadline"),
        (("a", "--reason", ""), ["a"], ""),
        (("a", "--reason", "y" * 100_000), ["a"], "cut to 200 of 100000"),
        (("a", "--reason", "\ud83e\x00"), ["a"], "cannot be printed"),
    ],
)
def test_no_argument_refuses_an_emergency_stop(
    run: Run, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], expected: list[str], said: str
) -> None:
    fake = FakeController(report(answer("a")))
    monkeypatch.setattr(safety_controller, "safety_controller", lambda *given, **more: fake)
    result = run("estop", *arguments)
    ((names, reason),) = fake.calls
    assert names == expected
    assert len(reason) <= 200
    assert said in result.stdout


def test_slow_and_silent_robots_are_red() -> None:
    progress = Progress("e" * 32, {"quick": answer("quick"), "slow": answer("slow", ms=170.0)}, ("mute",), True, 200.0)
    styles = {row[0]: str(row[1].style) for row in progress_rows(progress)}
    assert styles == {"quick": "green", "slow": "bold red", "mute": "bold red"}
    assert report_rows(report(answer("a"), silent=("b",)))[0][0] == "b"


def test_connecting_is_not_the_robots_time_and_an_outage_is_said() -> None:
    connected = Progress("e" * 32, {"a": answer("a", ms=430.0)}, (), True, 430.0, 420.0)
    assert str(progress_rows(connected)[0][2]) == "10.0"
    outage = replace(report(answer("a", ms=11_010.0)), elapsed_ms=11_010.0, left_ms=11_000.0)
    assert str(report_rows(outage)[0][2]) == "11010.0"
    assert "1 stopped, in 11010 ms. It left 11.0 s after the press." in summary(outage)


def test_exit_code_is_that_of_the_worst_answer() -> None:
    assert exit_code(report(answer("a", False), silent=("b",))) is Exit.REFUSED
    assert exit_code(report(answer("a"))) is Exit.OK


def test_stop_prints_each_verdict_and_exits_with_the_worst(run: Run, fleet: FakeFleet) -> None:
    fleet.stops = {"a": success("Stopped.", stopped=True)}
    assert run("stop", "a").exit_code == 0
    fleet.stops["b"] = error("no answer in 5 s", stopped=None)
    result = run("stop", "--all")
    assert result.exit_code == 3
    assert "NO ANSWER" in result.stdout
    assert "b" in result.stderr
    fleet.stops["c"] = error("the bus is wedged", stopped=False)
    result = run("stop", "--all", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["devices"]["c"] == {"stopped": False, "said": "the bus is wedged"}
    assert "DID NOT STOP" in run("stop", "--all").stdout


def test_stop_of_all_names_a_silent_robot_of_the_roster_as_an_emergency_stop_does(run: Run, fleet: FakeFleet) -> None:
    sightings().note(network_of(fleet.link), "arm-2", stoppable=True)
    assert sightings().flush(20.0)
    fleet.stops = {"arm-1": success("Stopped.", stopped=True)}
    result = run("stop", "--all")
    assert result.exit_code == 3
    assert "1 of the 2 robots of the roster said that they stand still" in result.stdout
    assert result.stderr == "NO ANSWER: arm-2.\n"
    said = json.loads(run("stop", "--all", "--json").stdout)
    assert (said["devices"]["arm-2"]["stopped"], said["roster"]["size"]) == (None, 2)
    assert "last heard" in said["reasons"]["arm-2"]
    recorded = [each["payload"] for each in read_audit_log() if each["event"] == "stop_outcome"]
    assert "last heard" in recorded[-1]["silent"]["arm-2"]


def test_unsigned_answers_to_a_stop_of_all_are_not_called_knowledge(run: Run, fleet: FakeFleet) -> None:
    fleet.stops = {"arm-1": success("Stopped.", stopped=True)}
    result = run("stop", "--all")
    assert result.exit_code == 0
    said = "The one robot of the roster said that it stands still; answers to a plain stop are not signed."
    assert said in " ".join(result.stdout.split())
    assert "known to stand still" not in result.stdout
    assert json.loads(run("stop", "--all", "--json").stdout)["unsigned"] is True


def test_stop_of_a_silent_robot_says_why(run: Run, fleet: FakeFleet) -> None:
    sightings().note(network_of(fleet.link), "arm-2", departing=True)
    assert sightings().flush(20.0)
    fleet.stops = {"arm-2": error("No device 'arm-2' in tenant 'default'.", stopped=None)}
    result = run("stop", "arm-2")
    assert result.exit_code == 3
    assert "No device 'arm-2' in tenant 'default': it said that it leaves the network" in result.stdout


def test_stop_of_all_whose_search_failed_is_no_success(run: Run, fleet: FakeFleet) -> None:
    fleet.stops, fleet.stale = {"arm-1": success("Stopped.", stopped=True)}, "The registry gave no list."
    result = run("stop", "--all")
    assert (result.exit_code, result.stderr) == (3, "The registry gave no list.\n")


def test_stop_of_one_robot_of_a_world_names_it(run: Run, fleet: FakeFleet) -> None:
    fleet.stops = {"world-1/left": success("Stopped left.", stopped=True)}
    result = run("stop", "world-1", "--robot", "left")
    assert result.exit_code == 0
    assert "Stopped left." in result.stdout
    assert "world-1/left" in result.stdout, "the other robots of the world may move on"


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("a", "--all"),
        ("--all", "--robot", "left"),
        ("--robot", "left"),
        ("a/b",),
        ("--timeout", "0"),
        ("x" * 1000,),
    ],
)
def test_no_argument_refuses_a_stop(run: Run, fleet: FakeFleet, arguments: tuple[str, ...]) -> None:
    fleet.stops = {"a": success("Stopped.", stopped=True)}
    result = run("stop", *arguments)
    assert result.exit_code == 0
    assert "Stopped." in result.stdout


@pytest.mark.parametrize("name", ["x" * 1000, "\x00"])
def test_a_stop_of_a_name_that_cannot_be_read_stops_all_of_the_device(run: Run, fleet: FakeFleet, name: str) -> None:
    fleet.stops = {"world-1": success("Stopped.", stopped=True)}
    result = run("stop", "world-1", "--robot", name)
    assert result.exit_code == 0
    assert "Ignored" in result.stdout


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
    assert stop_outcome(answer)[0] is stopped


def test_stop_of_an_unknown_device_names_the_near_ones(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [Peer("arm-1"), Peer("rover")]
    fleet.stops = {"amr-1": error("No device 'amr-1' in tenant 'default'.", stopped=None)}
    result = run("stop", "amr-1")
    assert result.exit_code == 3
    assert "Near it: arm-1." in result.stderr


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state directory without a key, and a working directory of its own."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state"


def printed_commands(capsys: pytest.CaptureFixture[str], flags: str) -> list[str]:
    show_resume(Screen(), None, flags)
    return [line.strip() for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]


def test_printed_resume_names_the_operators_key_that_is_found(state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state.mkdir()
    (state / "operator.pem").touch()
    network = Network(connect=["tcp/10.0.0.1:7447"], tenant="lab 1", insecure=True)
    assert printed_commands(capsys, network.flags) == [
        f"strands-robots resume --key {state}/operator.pem --connect tcp/10.0.0.1:7447 --tenant 'lab 1' --insecure",
        "strands-robots resume --local",
    ]


def test_without_an_operators_key_the_line_that_makes_it_is_printed(
    state: Path, tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    here, making = printed_commands(capsys, "")
    assert here == "strands-robots resume --local"
    passphrase = tmp_path / "passphrase"
    passphrase.write_text("Correct-Horse-7-Battery\n")
    passphrase.chmod(0o600)
    assert run(*shlex.split(making)[1:], "--passphrase-file", str(passphrase)).exit_code == 0
    then, at_the_robot = printed_commands(capsys, "")
    assert at_the_robot == here, "robots may not know that key yet"
    assert then == f"strands-robots resume --key {state}/operator.pem"


class Lookup:
    """A fleet whose tries to look robots up end as ``tries`` say: with robots, or with an error."""

    def __init__(self, *tries: list[str] | Exception, stale: str = "") -> None:
        self.tries, self.stale = list(tries), stale
        self.failed, self.left = threading.Event(), threading.Event()

    def __call__(self, link: object, source: str) -> Lookup:
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.left.set()

    def peers(self, timeout: float, *, thorough: bool) -> list[Peer]:
        outcome = self.tries.pop(0)
        if isinstance(outcome, Exception):
            if not self.tries:
                self.failed.set()
            raise outcome
        return [Peer(name, functions=({"name": "stop"},)) for name in outcome]


class LookingController(FakeController):
    """A stop that ends once its robots were named, or with the event ``until``."""

    def __init__(self, stop_report: StopReport, until: threading.Event | None = None, *, over: bool = False) -> None:
        super().__init__(stop_report)
        self.named: list[set[str]] = []
        self._over, self._until = over, until or threading.Event()

    def stop(self, expected: Collection[str], reason: str, **more: Any) -> StopReport:
        more["on_progress"](Progress(more["estop_id"], self.report.answered, (), True, 1.0))
        assert self._over or self._until.wait(20)
        return super().stop(expected, reason)

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        if not more:
            self.named.append(set(names))
            self._until.set()
        return not self._over


@pytest.fixture
def estop(run: Run, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    def one(lookup: Lookup, controller: FakeController, *arguments: str) -> Result:
        monkeypatch.setattr(device_connect, "FleetClient", lookup)
        monkeypatch.setattr(safety_controller, "safety_controller", lambda *given, **more: controller)
        return run("estop", *arguments)

    return one


@pytest.mark.parametrize("kind", [RegistryError, MessagingError, TimeoutError, OSError, ValueError])
@pytest.mark.parametrize("moving", [False, True])
def test_estop_whose_robots_could_not_be_looked_up_is_no_success(
    estop: Callable[..., Result], kind: type[Exception], moving: bool
) -> None:
    lookup = Lookup(kind("the broker is gone."), kind("the broker is gone."))
    controller = LookingController(report(answer("a"), answer("b", not moving)), lookup.failed)
    result = estop(lookup, controller)
    assert result.exit_code == (1 if moving else 3)
    said = "The robots that must answer could not be looked up: the broker is gone."
    assert said in " ".join(result.stderr.split())
    assert controller.named == []


def test_robots_that_are_found_at_the_second_try_must_answer(estop: Callable[..., Result]) -> None:
    controller = LookingController(report(answer("a"), answer("b"), answer("c")))
    result = estop(Lookup(RegistryError("the database is gone"), ["b", "c"]), controller)
    assert result.exit_code == 0
    assert controller.named == [{"a", "b", "c"}]
    assert "looked up" not in result.stdout + result.stderr


def test_estop_says_so_when_the_registry_gave_no_list(estop: Callable[..., Result]) -> None:
    stale = "The registry gives no list (no answer in time): devices may be missing."
    result = estop(Lookup(["a"], stale=stale), LookingController(report(answer("a"))), "--json")
    assert result.exit_code == 3
    assert stale in json.loads(result.stdout)["reason"]


def test_estop_whose_robots_are_found_after_its_end_asks_them_all_the_same(estop: Callable[..., Result]) -> None:
    assert estop(Lookup(["a"]), LookingController(report(answer("a")), over=True)).exit_code == 0


def test_estop_whose_robots_are_not_found_in_time_is_no_success(
    estop: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    lookup, over = Lookup(), threading.Event()
    monkeypatch.setattr(lookup, "peers", lambda *_, **__: over.wait(20) and [])
    result = estop(lookup, LookingController(report(answer("a")), over=True), "--deadline", "0.1")
    over.set()
    assert result.exit_code == 3
    assert "could not be looked up: no list of them in time." in " ".join(result.stderr.split())


def test_robots_that_are_named_are_not_looked_up(estop: Callable[..., Result]) -> None:
    assert estop(Lookup(), FakeController(report(answer("a"))), "a").exit_code == 0


def test_stop_that_raises_at_once_leaves_no_lookup_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(FakeController):
        def stop(self, expected: Collection[str], reason: str, **more: Any) -> StopReport:
            raise OSError(24, "Too many open files")

    lookup = Lookup()
    monkeypatch.setattr(device_connect, "FleetClient", lookup)
    monkeypatch.setattr(safety_controller, "safety_controller", lambda *given, **more: Broken(report()))
    with pytest.raises(UnreachableError, match="Too many open files"):
        DeviceConnectNetwork(loopback_config(), "desk").emergency_stop(StopRequest())
    assert lookup.left.wait(20)
