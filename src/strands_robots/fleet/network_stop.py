"""Verdict of a network that a stop did not reach."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future

from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.fleet_verdict import NetworkVerdict
from strands_robots.fleet.stop_answers import measured
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.silence import Sending
from strands_robots.safety.stop_roster import StopOutcome, StopRoster
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)


def not_left(network: str, key: Callable[[], NetworkKey], why: object) -> NetworkVerdict:
    """Return the verdict of a network that a stop did not reach.

    Args:
        network: its name.
        key: returns the name under which its robots are remembered.
        why: the reason.
    """
    said = plain_text(str(why)) or type(why).__name__
    try:
        roster = StopRoster(key())
        # On a thread: a disk that hangs is waited for within a bound, by the outcome.
        threading.Thread(target=roster.read, name="stop roster", daemon=True).start()
        outcome = measured({}, roster, Sending(left=False))
    except Exception as exc:  # noqa: BLE001 - the roster's disk must not hide the verdicts of other networks
        logger.warning("The roster of %s cannot be read: %s", network, exc)
        return NetworkVerdict(network, absent=said)
    return NetworkVerdict(network, outcome, absent=said)


def stop_beside(network: NetworkAdapter, stop: Callable[[NetworkAdapter], StopOutcome]) -> Future[NetworkVerdict]:
    """Join a network and stop its robots, on a thread of its own.

    The result names the robots that must answer where the network cannot be joined; it raises nothing.

    Args:
        network: that is joined, and left at the end.
        stop: stops the robots of the network, once it is joined.
    """
    verdict: Future[NetworkVerdict] = Future()

    def work() -> None:
        try:
            network.open()
            try:
                outcome = stop(network)
            finally:
                network.close()
        except Exception as exc:  # noqa: BLE001 - a stop that fails is a verdict, whatever it raised
            verdict.set_result(not_left(network.name, lambda: network.key, exc))
        else:
            verdict.set_result(NetworkVerdict(network.name, outcome))

    threading.Thread(target=work, name=f"stop on {network.name}", daemon=True).start()
    return verdict
