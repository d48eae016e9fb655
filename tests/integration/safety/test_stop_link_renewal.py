"""A stop link that brings no answer is made anew, and brings the stop then."""

from __future__ import annotations

import threading

from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.device_connect.stop_link import ZenohStopLink
from strands_robots.safety.lane import lane
from strands_robots.safety.links import RenewableLink, notification


def test_a_renewed_link_carries_stops_again_and_leaves_no_thread() -> None:
    link, world = loopback_config(free_port()), ToyWorld("arm-1")
    runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
    hand, told = ZenohStopLink(link), list[bool]()
    try:
        hand.open((), lambda event, source, data: None, told.append)
        eventually(lambda: hand.up and all(seat.link.up for seat in lane().seats), within=15)
        assert isinstance(hand, RenewableLink)
        hand.renew()
        eventually(lambda: told[:3] == [True, False, True], within=15)
        order = {"estop_id": "0" * 31 + "1", "source": "safety-1", "reason": "after a renewal"}
        stop = notification("emergencyStop", order)
        eventually(lambda: hand.publish("safety-1", "emergencyStop", stop) and world.gate.refusal("execute"), within=10)
    finally:
        hand.close()
        stop_device_connect(runtime)
        world.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "stop-link"]
