"""The page's hand takes over from a policy, pushes, gives back, and ends with a stop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest
from fixtures.desk import desk
from fixtures.waiting import eventually_async, until

from strands_robots.cli.far_hand import LeadableHere
from strands_robots.dashboard.page_lead import ALIVE_S, PageLead, ShownPictures
from strands_robots.dashboard.pictures import TimedPicture
from strands_robots.envelope import Envelope, success
from strands_robots.fleet.far_lead import FarLead
from strands_robots.simulation import Simulation


@pytest.fixture
def world() -> Iterator[Simulation]:
    with desk() as made:
        yield made


class Led:
    """A hand at an arm that a policy drives, and what it told."""

    def __init__(self, world: Simulation, pictures: ShownPictures | None = None) -> None:
        self.told: list[tuple[str, str]] = []
        self.gone: list[str] = []
        self.losses: list[str] = []
        self.ends: list[tuple[str, bool]] = []
        self.world = world
        lead = LeadableHere(world).lead("page", policy_provider="mock", instruction="wave", guide="differences")
        self.hand = PageLead(lead, self, pictures)

    def turned(self, state: str, why: str) -> None:
        self.told.append((state, why))

    def let_go(self, why: str) -> None:
        self.gone.append(why)

    def over(self, why: str, *, halted: bool) -> None:
        self.ends.append((why, halted))

    def lost(self, why: str) -> None:
        self.losses.append(why)

    def pan(self) -> float:
        return self.world.body("so100").get_joints()["shoulder_pan"]

    async def rests(self) -> None:
        """Wait until it stands, as far as its servos hold it."""

        async def still() -> bool:
            before = self.pan()
            await asyncio.sleep(0.1)
            self.hand.beat()
            return abs(self.pan() - before) < 0.002

        await eventually_async(still, what="it stands")

    async def state(self, wanted: str) -> str:
        """Wait for a state, and return its reason."""
        await until(lambda: bool(self.told) and self.told[-1][0] == wanted, what=wanted)
        return self.told[-1][1]


@asynccontextmanager
async def led(world: Simulation, pictures: ShownPictures | None = None) -> AsyncIterator[Led]:
    made = Led(world, pictures)
    try:
        await made.state("policy")
        yield made
    finally:
        await made.hand.end()


async def test_push_takes_over_and_the_robot_stands_once_it_is_let_go(world: Simulation) -> None:
    async with led(world) as arm:
        assert arm.hand.push("shoulder_pan", 1, 1.0) == ""
        await arm.state("led")
        start = arm.pan()

        def goes() -> bool:
            arm.hand.beat()
            return arm.pan() > start + 0.1

        await until(goes, what="it goes where it is pushed")
        arm.hand.release("released")
        assert arm.gone == ["released"]
        let_go_at = arm.pan()
        await arm.rests()
        assert arm.pan() == pytest.approx(let_go_at, abs=0.1), "it does not go on to where it was pushed"
        assert arm.told[-1][0] == "led"


class Robot:
    """A robot that is where it is set, and notes its commands."""

    def __init__(self) -> None:
        self.joints = {"pan": 0.0, "roll": 0.0}
        self.commands: list[dict[str, Any]] = []
        opened = success("page leads", lead_id="1", leader="page", ranges={"pan": [-9, 9], "roll": [-9, 9]}, now=0.0)
        self.lead = FarLead("arm-1", self.take, opened | self.facts("policy", 0), policy=True)

    def facts(self, state: str, turn: int) -> dict[str, Any]:
        return {"state": state, "turn": turn, "joints": dict(self.joints), "now": time.monotonic()}

    def take(self, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        self.commands.append(dict(arguments))
        leads, turn = arguments.get("leads", False), arguments.get("turn", 0)
        return success("taken", **self.facts("led" if leads else "policy", turn))

    def turns(self) -> list[dict[str, float]]:
        """Targets of the first command of each turn of the hand."""
        first: dict[int, dict[str, float]] = {}
        for each in sorted((each for each in self.commands if each.get("leads")), key=lambda each: each["seq"]):
            first.setdefault(each["turn"], each["targets"])
        return list(first.values())


class Unheard:
    """Nobody listens."""

    def turned(self, state: str, why: str) -> None: ...
    def let_go(self, why: str) -> None: ...
    def over(self, why: str, *, halted: bool) -> None: ...
    def lost(self, why: str) -> None: ...


async def test_each_turn_of_the_hand_begins_with_where_the_robot_is_then() -> None:
    robot = Robot()
    hand = PageLead(robot.lead, Unheard())
    try:
        for place in (1.0, 2.0, 3.0):
            robot.joints = {"pan": place, "roll": -place}
            await until(lambda place=place: hand_sees(robot, place), what="the robot tells where it is")
            assert hand.push("pan", 1, 0.01) == ""
            await until(lambda: robot.lead.state.state == "led", what="the hand leads")
            hand.give_back()
            await until(lambda: robot.lead.state.state == "policy", what="the policy has it back")
        begun = [(each["pan"], -each["roll"]) for each in robot.turns()]
        assert {round(there) for _, there in begun} == {1, 2, 3}
        assert [pan for pan, _ in begun] == pytest.approx([there for _, there in begun], abs=0.05)
    finally:
        await hand.end()


def hand_sees(robot: Robot, place: float) -> bool:
    return robot.lead.state.joints["pan"] == place


async def test_robot_whose_page_is_not_heard_is_given_up(world: Simulation) -> None:
    async with led(world) as arm:
        began = time.monotonic()
        await until(lambda: bool(arm.losses) or arm.hand.alive() or time.monotonic() > began + 2 * ALIVE_S)
        assert not arm.losses, "the page was there"
        await until(lambda: bool(arm.losses), what="it is given up")
        assert arm.losses == ["nothing was heard of the page for 1 s"]


async def test_push_ends_without_beats_and_the_hand_leads_on(world: Simulation) -> None:
    async with led(world) as arm:
        arm.hand.push("shoulder_pan", 1, 0.3)
        await until(lambda: bool(arm.gone), what="the push ends")
        assert arm.gone == ["no beat of the page for 200 ms"]
        assert not arm.hand.pushes and not arm.ends


async def test_policy_that_has_it_back_drives_on(world: Simulation) -> None:
    async with led(world) as arm:
        arm.hand.push("shoulder_pan", 1, 0.3)
        await arm.state("led")
        arm.hand.give_back()
        await arm.state("policy")
        before = arm.pan()
        await until(lambda: abs(arm.pan() - before) > 0.02, what="the policy moves it")


@pytest.mark.parametrize("state", ["policy", "led"])
async def test_stop_ends_the_lead_in_each_state(world: Simulation, state: str) -> None:
    async with led(world) as arm:
        if state == "led":
            arm.hand.push("shoulder_pan", 1, 0.2)
            await arm.state("led")
        await asyncio.to_thread(world.halt, "stop")
        await until(lambda: bool(arm.ends), what="the end")
        (why, halted), *_ = arm.ends
        assert halted and "it was stopped" in why
        assert not world.teleoperating()


@pytest.mark.parametrize("name", ["elbow", "constructor", ""])
async def test_joint_that_it_has_not_cannot_be_pushed(world: Simulation, name: str) -> None:
    async with led(world) as arm:
        assert arm.hand.push(name, 1, 0.3) == f"{name} has no range in which it can be led."
        assert arm.told[-1][0] == "policy"


async def test_hand_is_held_once_the_page_shows_nothing_new_and_goes_on_at_a_new_push(world: Simulation) -> None:
    pictures = ShownPictures()
    shown = 0

    def show(picture: bytes) -> None:
        nonlocal shown
        shown += 1
        pictures.shown(pictures.send(TimedPicture(picture, time.monotonic())))

    async with led(world, pictures) as arm:
        arm.hand.push("shoulder_pan", 1, 0.3)

        def changing() -> bool:
            show(b"picture %d" % shown)
            arm.hand.beat()
            return arm.told[-1][0] == "led"

        await until(changing, what="it leads by pictures that change")

        def frozen() -> bool:
            show(b"the same")
            arm.hand.beat()
            return arm.told[-1][0] == "held"

        await until(frozen, what="it is held")
        assert "newest picture of page" in arm.told[-1][1]
        assert arm.gone[-1] == arm.told[-1][1]
        show(b"a new one")
        assert arm.hand.push("shoulder_pan", 1, 0.3) == ""
        await until(changing, what="it goes on at a new push")


def test_only_pictures_that_the_page_has_shown_count_from_when_they_were_taken() -> None:
    now = 0.0
    pictures = ShownPictures(lambda: now)
    first, second = pictures.send(TimedPicture(b"one", 1.0)), pictures.send(TimedPicture(b"two", 2.0))
    now = 5.0
    assert pictures.age_s == 5.0, "nothing was shown"
    pictures.shown(second)
    assert pictures.age_s == 3.0
    pictures.shown(pictures.send(TimedPicture(b"two", 4.5)))
    assert pictures.age_s == 3.0, "the same again shows nothing new"
    # The first one was passed over, and nobody has sent the other.
    pictures.shown(first)
    pictures.shown(99)
    assert pictures.age_s == 3.0
