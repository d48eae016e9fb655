"""The page's hand takes over from a policy, pushes, gives back, and ends with a stop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import pytest
from fixtures.waiting import until

from strands_robots.cli.far_hand import LeadableHere
from strands_robots.dashboard.page_lead import PageLead, ShownPictures
from strands_robots.simulation import Simulation


@pytest.fixture
def world() -> Iterator[Simulation]:
    made = Simulation(tool_name="desk")
    made.add_robot("so100")
    yield made
    made.halt("test over")
    made.cleanup()


class Led:
    """A hand at an arm that a policy drives, and what it told."""

    def __init__(self, world: Simulation, pictures: ShownPictures | None = None) -> None:
        self.told: list[tuple[str, str]] = []
        self.let_go: list[str] = []
        self.ends: list[tuple[str, bool]] = []
        self.world = world
        lead = LeadableHere(world).lead("page", policy_provider="mock", instruction="wave", guide="differences")
        self.hand = PageLead(
            lead,
            told=lambda state, why: self.told.append((state, why)),
            let_go=self.let_go.append,
            ended=lambda why, halted: self.ends.append((why, halted)),
            pictures=pictures,
        )

    def pan(self) -> float:
        return self.world.body("so100").get_joints()["shoulder_pan"]

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
        assert arm.let_go == ["released"]
        for _ in range(2):
            stood = arm.pan()
            await asyncio.sleep(0.2)
        assert arm.pan() == pytest.approx(stood, abs=0.01)
        assert arm.told[-1][0] == "led"


async def test_push_ends_without_beats_and_the_hand_leads_on(world: Simulation) -> None:
    async with led(world) as arm:
        arm.hand.push("shoulder_pan", 1, 0.3)
        await until(lambda: bool(arm.let_go), what="the push ends")
        assert arm.let_go == ["no beat of the page for 200 ms"]
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
        pictures.shown(pictures.send(picture, asyncio.get_running_loop().time()))

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
        assert arm.let_go[-1] == arm.told[-1][1]
        show(b"a new one")
        assert arm.hand.push("shoulder_pan", 1, 0.3) == ""
        await until(changing, what="it goes on at a new push")


def test_pictures_count_from_when_the_page_has_shown_them() -> None:
    now = 0.0
    pictures = ShownPictures(lambda: now)
    first, second = pictures.send(b"one", 0.0), pictures.send(b"two", 0.0)
    now = 5.0
    assert pictures.age_s == 5.0, "nothing was shown"
    pictures.shown(second)
    assert pictures.age_s == 0.0
    now = 6.0
    # The first one was passed over, and nobody has sent the other.
    pictures.shown(first)
    pictures.shown(99)
    assert pictures.age_s == 1.0
