"""Stops of one robot or one cell on the safety controller's screen and on the command line."""

from __future__ import annotations

import pytest
from fixtures.waiting import eventually
from tests.cli.conftest import Run
from tests.fleet.scripted_sender import ScriptedSender

from strands_robots.cli.output import Exit
from strands_robots.cli.safety_controller import ConsoleScreen
from strands_robots.cli.stop import exit_code
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.safety_console import SafetyConsole, StopButtons, WatchedRobots
from strands_robots.safety.answers import Answer, StopReport
from strands_robots.safety.identity import EnrolledKeys
from strands_robots.safety.lockout import Lockout, LockoutState
from strands_robots.safety.network_key import MESH, NetworkKey
from strands_robots.safety.persistence import LockoutStore, StoredLockout, hardware_key
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.sightings import sightings
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopRoster, robots_known_at
from strands_robots.serving.stop_arguments import network_emergency_stop, stop_scope

NETWORK = NetworkKey.of("device-connect", ["tcp/127.0.0.1:7447"])
ONLY = Scope.named(["arm-1"])


@pytest.mark.parametrize(
    ("only", "cell", "scope", "noted"),
    [
        (None, "", EVERY_ROBOT, ""),
        ([], None, EVERY_ROBOT, ""),
        (["arm-1"], "", ONLY, ""),
        ("arm-1", "", ONLY, ""),
        (["arm-1", "arm-2"], "", Scope.named(["arm-1", "arm-2"]), ""),
        (["world/left"], "", Scope.named(["world"]), "whole world"),
        (None, "cell-1", Scope(cell="cell-1"), ""),
        (["arm-1"], "cell-1", EVERY_ROBOT, "together"),
        (["arm 1"], "", EVERY_ROBOT, "all robots are stopped"),
        ([f"arm-{n}" for n in range(65)], "", EVERY_ROBOT, "all robots are stopped"),
        ({"arm-1": 1}, "", EVERY_ROBOT, "all robots are stopped"),
        (5, "", EVERY_ROBOT, "all robots are stopped"),
        (True, None, EVERY_ROBOT, "all robots are stopped"),
        (None, "*", EVERY_ROBOT, "all robots are stopped"),
        (None, 5, EVERY_ROBOT, "all robots are stopped"),
    ],
)
def test_scope_that_cannot_be_read_stops_every_robot_and_says_so(
    only: object, cell: object, scope: Scope, noted: str
) -> None:
    read, note = stop_scope(only, cell)
    assert read == scope
    assert noted in note and bool(noted) is bool(note)
    arguments, ignored = network_emergency_stop({"only": only, "cell": cell})
    assert (stop_scope(arguments["only"], arguments["cell"])[0], ignored) == (scope, note)


def row(name: str, cell: str | None = "") -> LockoutReport:
    return LockoutReport(name, facts={} if cell is None else {"cell": cell}, round_trip_ms=1.0)


def test_space_bar_stops_every_robot_whatever_was_pressed_before() -> None:
    sender, buttons = ScriptedSender(), StopButtons("test")
    buttons.add("near", sender, lambda scope: ())  # type: ignore[arg-type]
    buttons.press(ONLY)
    buttons.press(Scope(cell="cell-1"))
    buttons.press()
    eventually(lambda: len(sender.scopes) == 3 and not buttons.running)
    assert set(sender.scopes) == {ONLY, Scope(cell="cell-1"), EVERY_ROBOT}
    (latest,) = buttons.latest.values()
    assert latest.report is not None and latest.report.scope == EVERY_ROBOT
    buttons.review()
    buttons.close()


def test_chosen_robot_and_its_cell_are_stopped_and_without_one_every_robot() -> None:
    console, watched = SafetyConsole(Networks([])), WatchedRobots()
    console.watched = {"near": watched}
    screen = ConsoleScreen(console, "safety-1", None)
    assert screen.chosen_scope(cell=False) == EVERY_ROBOT
    watched.update([row("arm-1", "cell-1"), row("arm-2", "cell-2"), row("nowhere"), row("older", None)])
    screen.choose(1)
    assert screen.chosen_scope(cell=False) == ONLY
    assert screen.chosen_scope(cell=True) == Scope(cell="cell-1")
    screen.choose(-1)
    assert screen.chosen_scope(cell=True) == EVERY_ROBOT
    # What states no cell reads no scope, and has to answer as well.
    assert set(watched.expected(ONLY)) == {"arm-1", "older"}
    assert set(watched.expected(Scope(cell="cell-1"))) == {"arm-1", "nowhere", "older"}
    assert set(watched.expected()) == {"arm-1", "arm-2", "nowhere", "older"}


def answers(*names: str) -> dict[str, Answer]:
    return {name: Answer(name, True, 3.0, "") for name in names}


def report(*names: str, scope: Scope = ONLY, widened: bool = False) -> StopReport:
    return StopReport("e" * 32, answers(*names), {}, {}, (), True, 9.0, scope=scope, widened=widened)


def remember(**cells: str) -> None:
    for name, cell in cells.items():
        sightings().note(NETWORK, name.replace("_", "-"), cell=cell, stoppable=True)
    assert sightings().flush(20.0)


def roster(scope: Scope) -> StopRoster:
    made = StopRoster(NETWORK, scope=scope)
    made.read()
    return made


def test_roster_of_a_stop_has_the_robots_in_its_scope() -> None:
    remember(arm_1="cell-1", arm_2="cell-2", nowhere="")
    outcome = roster(ONLY).outcome(report("arm-1"))
    assert exit_code(outcome) is Exit.OK
    assert outcome.size == 1
    assert "for arm-1 only" in stop_notes(outcome)[0]
    cell = Scope(cell="cell-1")
    outcome = roster(cell).outcome(report("arm-1", scope=cell))
    assert (outcome.report.silent, exit_code(outcome)) == (("nowhere",), Exit.SILENT)


def test_robot_that_stops_anyway_has_to_answer() -> None:
    remember(arm_1="")
    made = roster(ONLY)
    made.find({"arm-1": True, "bare": True, "arm-2": True}, {"arm-1": "", "bare": None, "arm-2": ""})
    assert made.awaited() == {"arm-1", "bare"}
    outcome = made.outcome(report("arm-1"))
    assert outcome.report.silent == ("bare",)
    assert made.outcome(report("arm-1", "bare", "yesterday")).ok


def test_widened_stop_is_measured_by_every_robot_and_is_never_success() -> None:
    remember(arm_1="", arm_2="")
    scope = Scope.named(["arm-9"])
    outcome = roster(scope).outcome(report("arm-1", "arm-2", scope=scope, widened=True))
    assert outcome.report.silent == ("arm-9",)
    assert exit_code(outcome) is Exit.SILENT
    assert any("very robot was stopped" in note for note in stop_notes(outcome))
    everyone = roster(Scope(cell="cell-9")).outcome(report("arm-1", "arm-2", scope=Scope(cell="cell-9"), widened=True))
    assert everyone.report.silent == () and exit_code(everyone) is Exit.SILENT


def test_machine_knows_the_robots_of_its_roster() -> None:
    remember(arm_1="cell-1", nowhere="")
    known = robots_known_at(lambda: NETWORK)
    assert known(ONLY) and known(Scope(cell="cell-1"))
    assert not known(Scope.named(["arm-9"]))
    # A robot without a cell stops with each, and makes none of them known.
    assert not known(Scope(cell="cell-9"))


def test_machine_knows_an_enrolled_robot_in_the_cell_of_its_enrolment() -> None:
    EnrolledKeys().enroll({"arm-1": b"1" * 32}, network=NETWORK, cells={"arm-1": "cell-1"})
    known = robots_known_at(lambda: NETWORK)
    assert known(Scope(cell="cell-1"))
    assert not known(Scope(cell="cell-2"))


def test_stop_of_named_robots_on_the_mesh_reaches_no_other_one() -> None:
    mesh = StopRoster(NetworkKey.of(MESH, ["tcp/127.0.0.1:7447"]), scope=ONLY)
    mesh.read()
    (said,) = [note for note in stop_notes(mesh.outcome(report("arm-1", scope=ONLY))) if "This stop was for" in note]
    assert said == "This stop was for arm-1 only."
    remember(arm_1="")
    notes = stop_notes(roster(ONLY).outcome(report("arm-1", scope=ONLY)))
    assert any("stop all the same" in note for note in notes)


def test_lockout_table_shows_the_scope(run: Run) -> None:
    kept = StoredLockout(LockoutState((Lockout("e" * 32, "safety-1", "smoke", 1.0, ONLY),)), name="arm-1")
    LockoutStore().save({hardware_key("arm", "1"): kept})
    shown = run("lockout", "--local")
    assert "by safety-1 for arm-1 only: smoke" in " ".join(shown.stdout.split())
