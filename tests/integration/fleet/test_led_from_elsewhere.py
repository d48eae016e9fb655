"""A robot of another process that is led from here, on both networks: hold, stop, kill, second leader, turns."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND
from fixtures.forked import COMMANDS, start
from fixtures.leaders import write_csv
from fixtures.waiting import eventually, free_port

from strands_robots.errors import RefusalError
from strands_robots.fleet import RemoteRobot, connect
from strands_robots.fleet.far_lead import FarLead
from strands_robots.fleet.reports import runs
from strands_robots.mesh.session import clear_peers

BEAT_S = 0.02


@dataclass
class Site:
    """A simulated arm that another process serves, and how a leader of a third process reaches it."""

    robot: RemoteRobot
    mesh: bool


@pytest.fixture(scope="module", params=[False, True], ids=["device_connect", "mesh"])
def site(request: pytest.FixtureRequest) -> Iterator[Site]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
            patch.setenv(name, str(free_port()))
        line = ["serve", "so100", "--peer-id", "arm-1", "--json", *(["--mesh"] if request.param else [])]
        child = subprocess.Popen([*COMMAND, *line], stdout=subprocess.PIPE)
        try:
            assert child.stdout is not None
            assert child.stdout.readline(), "it is served"
            with connect(mesh=request.param) as fleet:
                eventually(lambda: "arm-1" in {each.id for each in fleet.robots()}, within=60)
                yield Site(fleet["arm-1"], request.param)
        finally:
            child.kill()
            child.communicate()
            clear_peers()


@pytest.fixture
def robot(site: Site) -> RemoteRobot:
    return site.robot


@contextmanager
def led(robot: RemoteRobot, **how: Any) -> Iterator[FarLead]:
    """Lead the arm, and have it stand still at the end."""
    try:
        with robot.lead("hand", **how) as lead:
            yield lead
    finally:
        assert robot.halt().stopped


def beat(lead: FarLead, action: Mapping[str, float], until: Any, within: float = 20.0, *, holds: bool = False) -> None:
    """Send a command fifty times a second until a condition is true.

    Args:
        lead: of the robot.
        action: sent each time.
        until: the condition.
        within: seconds.
        holds: False to go on after the hold of a busy machine.
    """
    deadline = time.monotonic() + within
    while not until():
        assert time.monotonic() < deadline, lead.state
        if not holds and lead.state.state == "held" and lead.state.turn >= lead.turn:
            (lead.grip if lead.leads else lead.give_back)()
        lead.send(action)
        time.sleep(BEAT_S)


def wrist(robot: RemoteRobot) -> float:
    state = robot.state()
    joints = state["robots"]["so100"] if "robots" in state else state["joints"]
    return float(joints["wrist_roll"])


def test_arm_goes_where_its_leader_is_and_holds_in_its_silence(robot: RemoteRobot) -> None:
    with led(robot) as lead:
        start = dict(lead.state.joints)
        target = {**start, "shoulder_pan": start["shoulder_pan"] + 0.3}
        beat(lead, target, lambda: abs(lead.state.joints["shoulder_pan"] - target["shoulder_pan"]) < 0.01)
        assert lead.state.written["shoulder_pan"] == pytest.approx(target["shoulder_pan"])
        far = {**start, "shoulder_pan": -1.5}
        time.sleep(0.5)
        beat(lead, far, lambda: lead.state.state == "held", holds=True)
        assert "no fresh command of hand" in lead.state.why
        assert lead.state.joints["shoulder_pan"] == pytest.approx(target["shoulder_pan"], abs=0.02)
        lead.grip()
        beat(lead, far, lambda: lead.state.joints["shoulder_pan"] < -1.0)


def test_second_leader_is_refused_by_the_first_ones_name(site: Site, tmp_path: Path) -> None:
    write_csv(tmp_path / "run.csv", [(0.0, {"shoulder_pan": 0.0})])
    line = [*COMMAND, "replay", str(tmp_path / "run.csv"), "--to", "arm-1", *(["--mesh"] if site.mesh else [])]
    with site.robot.events(timeout=20) as events, led(site.robot) as lead:
        with start(line, imports=COMMANDS, stderr=subprocess.PIPE, text=True) as other:
            beat(lead, dict(lead.state.joints), lambda: other.poll() is not None)
            refused = other.communicate()[1]
        assert re.search(r"(is driven by hand|hand leads it)", refused), refused
        beat(lead, dict(lead.state.joints), lambda: lead.state.state == "led")
        assert runs(site.robot.status()), "a led robot is at work"
        assert any(each.task and each.task["instruction"] == "follow hand" for each in events), "and announces it"
    assert not runs(site.robot.status())


def test_stop_ends_the_lead_and_the_leader_is_told(robot: RemoteRobot) -> None:
    with led(robot) as lead:
        action = dict(lead.state.joints)
        beat(lead, action, lambda: lead.state.state == "led")
        assert robot.halt().stopped
        with pytest.raises(RefusalError, match="The lead of hand is over"):
            beat(lead, action, lambda: False)


def test_policy_and_leader_drive_in_turns(site: Site) -> None:
    robot = site.robot
    with (
        robot.events(timeout=20) as events,
        led(robot, policy_provider="mock", instruction="wave", guide="differences") as lead,
    ):
        still = dict(lead.state.joints)
        beat(lead, still, lambda: lead.state.state == "policy" and bool(lead.state.written))
        before = lead.state.written
        beat(lead, still, lambda: lead.state.written != before)
        lead.grip()
        beat(lead, still, lambda: lead.state.state == "led")
        here = dict(lead.state.written)
        for _ in range(10):
            lead.send(still)
            time.sleep(BEAT_S)
        assert lead.state.written == pytest.approx(here, abs=0.02), "a hand that does not move leaves it where it is"
        lead.give_back()
        beat(lead, still, lambda: lead.state.state == "policy" and lead.state.written != here)
        told = (each.payload["state"] for each in events if each.name == "turnChanged")
        # A busy machine may have held it between two of them.
        assert all(state in told for state in ("policy", "led", "policy"))


KILLED = """
import sys, time
from strands_robots.fleet import connect
with connect(mesh=sys.argv[1] == "True") as fleet:
    lead = fleet["arm-1"].lead("hand", max_speed=0.2)
    start = dict(lead.state.joints)
    while True:
        lead.send({**start, "wrist_roll": 3.0})
        if lead.state.joints["wrist_roll"] > 0.3:
            print("moves", flush=True)
        time.sleep(0.02)
"""


def test_robot_of_a_killed_leader_holds_where_it_was(site: Site) -> None:
    child = subprocess.Popen([sys.executable, "-c", KILLED, str(site.mesh)], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "moves\n"
    finally:
        child.kill()
        child.communicate()
    places = [wrist(site.robot)]

    def rests() -> bool:
        places.append(wrist(site.robot))
        return abs(places[-1] - places[-2]) < 1e-3

    eventually(rests, every=0.1)
    assert places[-1] < 1.5, "it never went where its leader had sent it"
    with pytest.raises(RefusalError, match=r"(is driven by hand|hand leads it)"):
        site.robot.lead("other")
    assert site.robot.halt().stopped
    with site.robot.lead("other") as lead:
        beat(lead, dict(lead.state.joints), lambda: lead.state.state == "led")
