"""After a fleet e-stop: the peers that did not answer get the same stop again when they are back, until they stopped.

A link that parted, or a hub that hangs, loses what is published meanwhile, and Zenoh keeps nothing for those who come
back. So whoever issued the stop brings it to them itself, for as long as it holds that stop's lockout.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from strands_robots.mesh.context import Context
from strands_robots.mesh.rpc import Caller, stop_outcome
from strands_robots.safety.stopping import Outcome, explain
from strands_robots.utils import shown

logger = logging.getLogger(__name__)

EVERY_S = 0.55
ANSWER_S = 1.0
TRIES = 10  # of a peer that is in reach and does not answer; access rules may keep it from us
KNOWN_S = 600.0
"""A peer heard of within these seconds is brought the stop when it comes back; a newcomer is not."""


class Pursuit:
    """Brings one emergency stop to the peers that missed it.

    Args:
        name: of the thread; it runs while somebody is missing.
    """

    def __init__(self, context: Context, caller: Caller, name: str) -> None:
        self._context = context
        self._caller = caller
        self._name = name
        self._over = threading.Event()

    def begin(self, epoch: str, missing: Iterable[str], held: Callable[[], bool], publish: Callable[[], None]) -> None:
        """Pursue ``missing`` until all have stopped, ``held`` says that the stop is over, or this peer leaves.

        Args:
            publish: publishes the stop's envelope once more.
        """
        self._over.set()  # a later stop is answered for an earlier one as well
        over = self._over = threading.Event()
        left = set(missing)
        if left:
            pursue = threading.Thread(
                target=self._run, args=(over, epoch, left, held, publish), name=self._name, daemon=True
            )
            pursue.start()

    def _run(
        self, over: threading.Event, epoch: str, left: set[str], held: Callable[[], bool], publish: Callable[[], None]
    ) -> None:
        began, silences = self._context.monotonic(), Counter[str]()
        named: set[tuple[str, Outcome]] = set()
        while left and not over.wait(EVERY_S) and self._context.transport is not None and held():
            back = sorted(peer for peer in left if self._heard_since(began, peer))
            if back:
                publish()
            for peer in back:
                if over.is_set():
                    return
                reply: dict[str, Any] = self._caller.send(peer, {"action": "stop"}, ANSWER_S)
                outcome = stop_outcome(reply)
                if outcome is Outcome.STOPPED:
                    left.discard(peer)
                    logger.warning("%s was out of reach and has answered emergency stop %s now.", peer, epoch)
                elif outcome is Outcome.TIMED_OUT:
                    silences[peer] += 1
                    if silences[peer] >= TRIES:
                        left.discard(peer)
                        logger.critical("%s is in reach and does not answer emergency stop %s.", peer, epoch)
                elif (peer, outcome) not in named:
                    named.add((peer, outcome))
                    why = explain(reply.get("result")) if "result" in reply else shown(reply.get("error"))
                    logger.critical("%s is in reach and did NOT stop on emergency stop %s: %s", peer, epoch, why)

    def _heard_since(self, began: float, peer: str) -> bool:
        row = self._context.registry.get(peer, self._context.monotonic() - began)
        return row is not None and bool(row["reachable"])
