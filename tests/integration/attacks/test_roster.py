"""Robots that were away during a one-shot stop are named, and lock themselves when they are back."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.network_lab import missing
from fixtures.roster_lab import KINDS, Kind, RosterLab
from fixtures.roster_returns import CASES, Returning, cases_on
from fixtures.roster_trials import Absence, stop_while_away
from fixtures.waiting import eventually

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]

AWAY = ("arm-1", "arm-2", "arm-3")
STOP = ("estop", "--deadline", "2")


AWAY_ON: list[tuple[Kind, Absence, str]] = [
    ("zenoh d2d", "frozen", "robots"),
    ("zenoh router", "frozen", "robots"),
    ("nats", "frozen", "console"),
    ("mesh", "frozen", "robots"),
    ("nats", "frozen long", "robots"),
    ("zenoh d2d", "frozen long", "robots"),
    ("zenoh d2d", "cut off", "robots"),
    ("zenoh router", "cut off", "robots"),
    ("nats", "cut off", "robots"),
    ("mesh", "cut off", "console"),
    ("nats", "cut off briefly", "robots"),
    ("zenoh router", "redialling", "robots"),
]
"""Each absence, and each network; ``make bench ARGS=roster`` takes all of them a hundred times."""


@pytest.fixture(params=["nats"])
def kind(request: pytest.FixtureRequest) -> Kind:
    made: Kind = request.param
    return made


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


@pytest.fixture
def lab(kind: Kind, tmp_path: Path, stack: ExitStack) -> RosterLab:
    return RosterLab(kind, tmp_path, stack)


@pytest.mark.parametrize(("kind", "absence", "state"), AWAY_ON)
def test_robots_away_during_a_one_shot_stop_are_named_and_lock_themselves(
    kind: Kind, absence: Absence, state: str, tmp_path: Path, stack: ExitStack
) -> None:
    cut = not absence.startswith("frozen")
    if cut and kind == "zenoh d2d" and (why := missing()):
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    lab = RosterLab(kind, tmp_path, stack, cuttable=cut)
    witness = lab.robots("arm-0", first=True)
    away = [lab.robots(name, cut=True) for name in AWAY]
    console = lab.console(state)
    lab.meet(console, "arm-0", *AWAY)
    trials = stop_while_away(lab, console, witness, away, absence)
    assert all(each.ok for each in trials), trials


@pytest.mark.parametrize(
    ("kind", "case"), [(KINDS[number % len(KINDS)], case) for number, case in enumerate(CASES)], indirect=["kind"]
)
def test_robot_that_comes_back_is_locked_by_what_it_missed_and_by_nothing_else(lab: RosterLab, case: str) -> None:
    if case not in cases_on(lab):
        pytest.skip("the mesh has no tenants")
    assert CASES[case](Returning(lab)) == ""


def enrolled(lab: RosterLab, *names: str) -> Machine:
    """Return a console that has enrolled these robots."""
    console = lab.console()

    def done() -> bool:
        return console.run("enroll", *names, *lab.flags).returncode == 0

    eventually(done, 60, "the robots enrolled")
    return console


def test_enrolled_robot_that_was_killed_is_named_with_exit_3(lab: RosterLab) -> None:
    witness, dead = lab.robots("arm-0", first=True), lab.robots("arm-1", state="elsewhere")
    console = enrolled(lab, "arm-0", "arm-1")
    dead.kill()
    forget_sightings(console, lab)
    code, said = console.json(*STOP, *lab.flags)
    assert (code, "arm-1" in str(said)) == (3, True), said
    assert witness.ask("epochs")["arm-0"]


@pytest.mark.parametrize("mark", ["--retire", "--off"])
def test_retired_or_switched_off_robot_is_printed_and_not_waited_for(lab: RosterLab, mark: str) -> None:
    lab.robots("arm-0", first=True)
    dead = lab.robots("arm-1", state="elsewhere")
    console = enrolled(lab, "arm-0", "arm-1")
    dead.kill()
    forget_sightings(console, lab)
    marked = console.run("enroll", mark, "arm-1", "--reason", "in the store", *lab.flags)
    assert marked.returncode == 0, marked.stderr
    said = console.run(*STOP, *lab.flags)
    assert said.returncode == 0, said.stderr + said.stdout
    assert "arm-1" in said.stdout + said.stderr
    again = lab.robots("arm-1", state="elsewhere")
    eventually(lambda: console.run(*STOP, *lab.flags).returncode == 0, 60, "it is there again, and stops")
    again.freeze()
    code, facts = console.json(*STOP, *lab.flags)
    assert (code, "arm-1" in str(facts)) == (3, True), facts


def forget_sightings(console: Machine, lab: RosterLab) -> None:
    """Let the console know no more than what it enrolled."""
    for each in lab.state("console").glob("sightings*"):
        each.unlink()
