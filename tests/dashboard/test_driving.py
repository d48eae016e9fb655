"""Driving by hand: leases, jogs, and every way in which a jog ends."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest
from fixtures.page_feed import PageFeed, page_robot
from fixtures.waiting import until

from strands_robots.dashboard import driving
from strands_robots.dashboard.driving import BEAT_S, HandControl, JogAxis
from strands_robots.envelope import error, is_error, success, text_of
from strands_robots.utils import ValidationError

ARM, KEY = "arm-1", "dc:arm-1"
JOG = {"kind": "joint", "axis": "pan", "direction": 1, "speed": 0.3}


class Page:
    """A page's control and what it was told."""

    def __init__(self) -> None:
        self.feed = PageFeed()
        self.told: list[dict[str, Any]] = []
        self.control = HandControl(self.told.append)

    async def take(self, **more: Any) -> Any:
        return await self.control.take(KEY, page_robot(self.feed, ARM), **more)

    async def jog(self, **changes: Any) -> None:
        assert self.control.begin(KEY, {**JOG, **changes}) == ""

    async def beating(self, until_done: Any) -> None:
        while not until_done():
            self.control.beat(KEY)
            await asyncio.sleep(0.02)

    def jogged(self) -> dict[str, Any] | None:
        return next((each for each in self.told if each["type"] == "jogged"), None)


@pytest.fixture
async def page() -> Any:
    made = Page()
    yield made
    await made.control.leave()


async def test_free_robot_is_acquired_for_a_human_with_a_short_lease(page: Page) -> None:
    assert not is_error(await page.take())
    assert page.feed.asked("acquireControl") == [{"kind": "human", "ttl_s": driving.LEASE_S}]
    assert page.control.lease(KEY) == {"lease_id": "lease-1"}
    await until(lambda: page.feed.asked("renewControl"), what="the lease is renewed")


async def test_secret_of_the_lease_is_not_told_to_the_page(page: Page) -> None:
    assert "lease_id" not in str(await page.take())


async def test_held_robot_is_taken_from_its_holder(page: Page) -> None:
    page.feed.answers["acquireControl"] = [
        error("agent-1 holds control", code="not_holder"),
        success("yours", lease_id="lease-3"),
    ]
    answer = await page.take()
    assert not is_error(answer)
    assert text_of(answer) == "Taken from agent-1, without a signature."
    assert page.feed.asked("takeControl")[0]["reason"]
    assert page.control.lease(KEY) == {"lease_id": "lease-3"}
    assert page.feed.asked("acquireControl")[1]["lease_id"] == "lease-2"


async def test_jog_needs_control(page: Page) -> None:
    assert "Take control" in page.control.begin(KEY, JOG)
    assert page.feed.calls == []


async def test_jog_moves_with_the_lease_and_stops_when_it_is_released(page: Page) -> None:
    await page.take()
    await page.jog()
    await page.beating(lambda: page.feed.asked("moveJoints"))
    moved = page.feed.asked("moveJoints")[0]
    assert (moved["joints"], moved["lease_id"], moved["wait"]) == ({"pan": 55.0}, "lease-1", False)
    page.control.release(KEY)
    await until(page.jogged)
    told = page.jogged()
    assert told is not None
    assert (told["stopped"], told["why"]) == (True, "released")
    assert page.feed.stops >= 1


async def test_jog_of_a_key_of_a_real_arm_moves_the_joint_of_its_model(page: Page) -> None:
    await page.take()
    await page.jog(axis="pan.pos")
    await page.beating(lambda: page.feed.asked("moveJoints"))
    assert page.feed.asked("moveJoints")[0]["joints"] == {"pan": 55.0}
    page.control.release(KEY)
    await until(page.jogged)


@pytest.mark.parametrize(("unit", "at"), [("degrees", 10.0), ("radians", 0.17453292519943295)])
async def test_joint_of_a_robot_without_a_model_is_jogged_from_its_state(page: Page, unit: str, at: float) -> None:
    page.feed.answers["getPose"] = [error("no model of pan_tilt is known")]
    page.feed.answers["getState"] = [success("here", joints={"pan.pos": at, "lift.pos": 3.0})]
    await page.take()
    assert page.control.begin(KEY, {**JOG, "axis": "pan.pos"}, {"pan.pos": unit}) == ""
    await page.beating(lambda: page.feed.asked("moveJoints"))
    assert page.feed.asked("moveJoints")[0]["joints"] == {"pan.pos": pytest.approx(55.0)}


async def test_joint_without_a_known_unit_is_not_jogged_and_the_reason_is_told(page: Page) -> None:
    page.feed.answers["getPose"] = [error("no model of pan_tilt is known")]
    page.feed.answers["getState"] = [success("here", joints={"pan.pos": 10.0})]
    await page.take()
    await page.jog()
    await page.beating(page.jogged)
    told = page.jogged()
    assert told is not None
    assert told["why"] == "no model of pan_tilt is known"
    assert page.feed.asked("moveJoints") == []


async def test_jog_without_a_beat_for_200_ms_is_stopped(page: Page) -> None:
    await page.take()
    began = time.monotonic()
    await page.jog()
    await until(lambda: page.feed.stops, what="the stop")
    assert time.monotonic() - began >= BEAT_S * 0.9
    await until(page.jogged)
    told = page.jogged()
    assert told is not None
    assert "no beat" in told["why"]


async def test_page_that_has_gone_stops_its_jog_and_gives_the_robot_back(page: Page) -> None:
    await page.take()
    await page.jog()
    await page.beating(lambda: page.feed.asked("moveJoints"))
    await page.control.leave()
    assert page.feed.stops >= 1
    assert page.feed.asked("releaseControl") == [{"lease_id": "lease-1"}]
    assert not page.control.holds(KEY)


async def test_page_that_has_gone_halts_what_it_held_even_without_a_jog(page: Page) -> None:
    await page.take()
    await page.control.leave()
    assert page.feed.stops == 1


@pytest.mark.parametrize("verb", ["acquireControl", "takeControl"])
async def test_robot_that_is_given_to_a_page_that_has_gone_is_given_back(page: Page, verb: str) -> None:
    if verb == "takeControl":
        busy = error("agent-1 holds control", code="not_holder")
        page.feed.answers["acquireControl"] = [busy, success("yours", lease_id="lease-1")]
    page.feed.slow[verb] = asyncio.Event()
    taking = asyncio.create_task(page.take())
    await until(lambda: page.feed.asked(verb))
    await page.control.leave()
    page.feed.slow[verb].set()
    assert is_error(await taking)
    assert page.feed.asked("releaseControl") == [{"lease_id": "lease-1"}]
    assert not page.control.holds(KEY)


async def test_command_that_the_stop_may_have_overtaken_is_stopped_again(page: Page) -> None:
    await page.take()
    page.feed.slow["moveJoints"] = asyncio.Event()
    await page.jog()
    await page.beating(lambda: page.feed.asked("moveJoints"))
    page.control.release(KEY)
    await until(lambda: page.feed.stops == 1)
    page.feed.slow["moveJoints"].set()
    await until(page.jogged)
    assert page.feed.stops >= 2


async def test_stop_that_is_not_confirmed_is_told_as_not_stopped(page: Page) -> None:
    page.feed.stop_answer = error("no brakes", stopped=False)
    await page.take()
    await page.jog()
    await until(page.jogged)
    told = page.jogged()
    assert told is not None
    assert told["stopped"] is False and "no brakes" in told["text"]


async def test_blocked_way_is_tried_in_shorter_stretches_and_then_refused(page: Page) -> None:
    page.feed.answers["moveJoints"] = [error("pan must be at most 126")]
    await page.take()
    await page.jog()
    await page.beating(page.jogged)
    ways = [each["joints"]["pan"] - 10.0 for each in page.feed.asked("moveJoints")]
    assert ways == list(driving.DEGREES)
    told = page.jogged()
    assert told is not None and told["refused"] and "126" in told["why"]


@pytest.mark.parametrize(
    "ended",
    [
        error("moveJoints stopped: it was stopped.", task_status="stopped"),
        error("moveJoints error: the arm touches the table.", task_status="error"),
        success("blocked", task_status="blocked"),
        error("the robot did not answer"),
    ],
)
async def test_motion_that_did_not_complete_ends_the_jog(page: Page, ended: Any) -> None:
    page.feed.answers["wait"] = [success("under way", task_status="running"), ended]
    await page.take()
    await page.jog()
    await page.beating(page.jogged)
    told = page.jogged()
    assert told is not None and told["refused"] and told["why"] == text_of(ended)
    assert len(page.feed.asked("moveJoints")) == 1
    assert page.feed.stops >= 1


async def test_motion_that_is_ended_before_its_answer_is_not_tried_in_shorter_stretches(page: Page) -> None:
    stopped = error("moveJoints stopped: it was stopped.", task_id="moveJoints-1", task_status="stopped")
    page.feed.answers["moveJoints"] = [stopped]
    await page.take()
    await page.jog()
    await page.beating(page.jogged)
    assert len(page.feed.asked("moveJoints")) == 1


async def test_motion_that_completed_is_followed_by_the_next_stretch(page: Page) -> None:
    page.feed.answers["wait"] = [success("done", task_status="completed"), success("under way", task_status="running")]
    await page.take()
    await page.jog()
    await page.beating(lambda: len(page.feed.asked("moveJoints")) == 2)
    page.control.release(KEY)
    await until(page.jogged)


async def test_base_is_not_driven_again_when_its_drive_is_over(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driving, "DRIVE_S", 0.1)
    await page.take()
    await page.jog(kind="base", axis="linear")
    await page.beating(page.jogged)
    told = page.jogged()
    assert told is not None and told["why"] == driving.DRIVEN
    assert len(page.feed.asked("drive")) == 1


async def test_lost_lease_ends_the_jog_and_is_told(page: Page) -> None:
    await page.take()
    await page.jog()
    page.feed.answers["renewControl"] = [error("agent-1 has taken control", code="displaced")]
    await page.beating(lambda: any(each["type"] == "control" for each in page.told))
    await until(page.jogged)
    assert not page.control.holds(KEY)


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "rocket"},
        {"direction": 0},
        {"direction": True},
        {"direction": 0.5},
        {"speed": 0},
        {"speed": float("nan")},
        {"speed": 2},
        {"axis": 7},
        {"kind": "tip", "axis": "w"},
        {"kind": "base", "axis": "pan"},
        {"part": 3},
    ],
)
def test_jog_out_of_its_domain_is_refused_by_name(change: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="|".join(("kind", "direction", "speed", "axis", "part"))):
        JogAxis.of({**JOG, **change})


@pytest.mark.parametrize("name", ["rail", "rail.pos"])
def test_slide_is_jogged_in_metres(name: str) -> None:
    axis = JogAxis.of({**JOG, "axis": name, "direction": -1})
    calls = axis.stretches({"rail": 0.2, "pan": 10.0}, {"rail": "metres", "rail.pos": "metres", "pan": "radians"})
    assert [params["joints"]["rail"] for _, params in calls] == [0.2 - each for each in driving.METRES]
    turning = JogAxis.of(JOG).stretches({"pan": 10.0}, {"rail": "metres", "pan": "radians"})
    assert [params["joints"]["pan"] for _, params in turning] == [10.0 + each for each in driving.DEGREES]


def test_base_is_driven_by_bounded_speeds() -> None:
    axis = JogAxis.of({"kind": "base", "axis": "angular", "direction": -1, "speed": 1})
    verb, params = axis.stretches({})[0]
    assert (verb, params["linear"], params["angular"]) == ("drive", 0.0, -driving.ANGULAR_RAD_S)


async def led(page: Page) -> Any:
    return await page.control.lead(KEY, "mock", "wave", pictures=False)


async def test_lead_needs_control_and_brings_its_lease(page: Page) -> None:
    assert "Take control" in text_of(await led(page))
    await page.take()
    assert not is_error(await led(page))
    (asked,) = page.feed.asked("lead")
    assert asked["lease_id"] == "lease-1"
    assert (asked["policy_provider"], asked["instruction"]) == ("mock", "wave")
    assert "already" in text_of(await led(page))


async def test_refusal_of_a_lead_is_the_answer(page: Page) -> None:
    page.feed.answers["lead"] = [error("hand of arm-9 leads it", refused="busy")]
    await page.take()
    assert text_of(await led(page)) == "hand of arm-9 leads it"
    assert "does not lead" in page.control.give_back(KEY)
    assert page.feed.stops == 0


async def test_page_that_goes_while_a_lead_begins_leaves_the_robot_stopped(page: Page) -> None:
    await page.take()
    page.feed.slow["lead"] = asyncio.Event()
    beginning = asyncio.create_task(led(page))
    await until(lambda: page.feed.asked("lead"), what="the lead is asked for")
    await page.control.leave()
    stops = page.feed.stops
    page.feed.slow["lead"].set()
    assert is_error(await beginning)
    assert page.feed.stops == stops + 1


@pytest.mark.parametrize("kind", ["tip", "gripper", "base"])
async def test_turns_with_a_policy_lead_joints_alone(page: Page, kind: str) -> None:
    await page.take()
    await led(page)
    axis = {"tip": "x", "gripper": "", "base": "linear"}[kind]
    assert "joints alone" in page.control.begin(KEY, {**JOG, "kind": kind, "axis": axis})
    assert page.control.begin(KEY, JOG) == ""


@pytest.mark.parametrize("ending", ["give", "leave", "end_lead"])
async def test_robot_is_stopped_before_the_end_of_the_lead_is_waited_for(page: Page, ending: str) -> None:
    await page.take()
    await led(page)
    page.feed.stopped.clear()
    ended = asyncio.create_task(page.control.leave() if ending == "leave" else getattr(page.control, ending)(KEY))
    await until(lambda: page.feed.stops == 1, what="the stop")
    assert not any("end" in each for each in page.feed.asked("leadTo"))
    page.feed.stopped.set()
    await ended
    assert page.feed.asked("leadTo")[-1]["end"] is True
    (over,) = [each for each in page.told if each.get("state") == "over"]
    assert over["stopped"] is True


async def test_lost_control_ends_the_lead_and_stops_no_other_holder(page: Page) -> None:
    await page.take()
    await led(page)
    page.feed.answers["renewControl"] = [error("agent-1 holds control", code="displaced")]
    await until(lambda: any(each.get("state") == "over" for each in page.told), what="the lead is over")
    assert page.feed.stops == 0
    assert not page.control.holds(KEY)


async def test_halt_of_a_led_robot_waits_for_nothing_of_the_lead(page: Page) -> None:
    await page.take()
    await led(page)
    assert page.control.begin(KEY, JOG) == ""
    page.control.cease(KEY, "it was halted")
    assert {"type": "let_go", "key": KEY, "why": "it was halted"} in page.told
    assert any(each.get("state") == "over" and each["why"] == "it was halted" for each in page.told)
    await until(lambda: any("end" in each for each in page.feed.asked("leadTo")), what="the end of the lead")
    assert {each.get("turn", 0) for each in page.feed.asked("leadTo")} <= {0, 1}, "it is not gripped once more"
    assert "does not lead" in page.control.give_back(KEY)


async def test_robot_that_did_not_answer_whether_it_is_led_is_stopped(page: Page) -> None:
    await page.take()
    page.feed.answers["lead"] = [error("no answer in 10 s")]
    assert is_error(await led(page))
    assert page.feed.stops == 1


async def test_robot_of_a_page_that_is_silent_is_stopped(page: Page) -> None:
    await page.take()
    await led(page)
    await until(lambda: any(each.get("state") == "over" for each in page.told), what="it is given up")
    assert page.feed.stops == 1
    assert "nothing was heard of the page" in page.told[-1]["why"]
