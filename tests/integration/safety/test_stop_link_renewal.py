"""A stop link that brings no answer is made anew, and brings the stop then."""

from __future__ import annotations

import threading

from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.device_connect.stop_link import ZenohStopLink
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.plane import plane
from strands_robots.safety.stop_link import RenewableLink, StopLink, notification


def seen_by(link: StopLink) -> set[str]:
    """The Zenoh ids of the sessions that a listener's link reaches."""
    assert isinstance(link, ZenohStopLink)
    return link.remotes


def stopped(hand: ZenohStopLink, world: ToyWorld, estop_id: str) -> None:
    """Send one stop until the world is locked."""
    order = notification("emergencyStop", {"estop_id": estop_id, "source": "safety-1", "reason": "a renewal"})
    eventually(lambda: hand.publish("safety-1", "emergencyStop", order) and world.gate.refusal("execute"))


def test_a_link_carries_stops_while_it_is_made_anew_and_leaves_no_thread() -> None:
    others = set(threading.enumerate())
    link, world = loopback_config(free_port()), ToyWorld("arm-1")
    runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
    hand, states = ZenohStopLink(link), list[bool]()
    try:
        hand.open((), lambda event, source, data: None, states.append)
        eventually(lambda: hand.up and all(each.link.up for each in estop_listener().registrations))
        assert isinstance(hand, RenewableLink)
        # The device's own session, which holds the meeting port, and the hand's.
        before = eventually(lambda: len(there := seen_by(estop_listener().registrations[0].link)) == 2 and there)
        hand.renew()
        hand.renew()
        for number in range(1, 4):
            # During the change and after it; a robot that gets a stop twice acts once.
            stopped(hand, world, f"{number:032x}")
            plane().clear_local("the test")
            if number == 2:
                eventually(lambda: len(seen_by(estop_listener().registrations[0].link) - before) == 1)
                eventually(lambda: not before <= seen_by(estop_listener().registrations[0].link))
        assert states and all(states), "it never was down"
        assert len(states) > 1, "the new session is one that may have missed a stop"
    finally:
        hand.close()
        stop_device_connect(runtime)
        world.close()
    eventually(lambda: not [each for each in threading.enumerate() if each not in others and each.name == "stop-link"])
