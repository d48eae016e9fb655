"""Repeats an emergency stop of this peer to those that did not confirm it."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from strands_robots.mesh.context import Context
from strands_robots.mesh.older_peers import SAFETY_S
from strands_robots.mesh.rpc import Requester, stop_outcome
from strands_robots.safety.stopping import Outcome, explain
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown

logger = stop_logger(__name__)

RETRY_EVERY_S = SAFETY_S
RETRY_ANSWER_S = 1.0
UNANSWERED_MAX = 10
"""Repeats to a peer that is in reach and does not answer; access rules may keep it from us."""


class EstopRetry:
    """Repeats an emergency stop to the peers that missed it, until they stopped.

    A link that parted, or a hub that hangs, loses what is published meanwhile, and Zenoh stores nothing for a peer
    that comes back. So the issuer repeats the stop itself, for as long as it is locked by it.
    """

    def __init__(self, context: Context, requester: Requester) -> None:
        self._context = context
        self._requester = requester
        self._over = threading.Event()

    def begin(
        self,
        epoch: str,
        missing: Iterable[str],
        locked: Callable[[], bool],
        publish: Callable[[], None],
        command: Callable[[str], dict[str, Any]] = lambda peer: {"action": "stop"},
    ) -> None:
        """Repeat the stop until ``missing`` have stopped or the lockout is over.

        Args:
            publish: publishes the stop's envelope once more.
            command: returns the command that stops a peer.
        """
        self._over.set()  # a later stop is answered for an earlier one as well
        over = self._over = threading.Event()
        left = set(missing)
        if left:
            name = f"mesh-{self._context.peer_id}-estop-retry"
            run = partial(self._run, over=over, epoch=epoch, left=left, locked=locked, publish=publish, command=command)
            threading.Thread(target=run, name=name, daemon=True).start()

    def _run(
        self,
        *,
        over: threading.Event,
        epoch: str,
        left: set[str],
        locked: Callable[[], bool],
        publish: Callable[[], None],
        command: Callable[[str], dict[str, Any]],
    ) -> None:
        began, silences = self._context.monotonic(), Counter[str]()
        logged: set[tuple[str, Outcome]] = set()
        while left and not over.wait(RETRY_EVERY_S) and self._context.transport is not None and locked():
            back = sorted(peer for peer in left if self._seen_since(began, peer))
            if back:
                publish()
            for peer in back:
                if over.is_set():
                    return
                reply = self._ask(peer, command(peer))
                outcome = stop_outcome(reply)
                if outcome is Outcome.STOPPED:
                    left.discard(peer)
                    logger.warning("%s has answered emergency stop %s now, and did not at first.", peer, epoch)
                elif outcome is Outcome.TIMED_OUT:
                    silences[peer] += 1
                    if silences[peer] >= UNANSWERED_MAX:
                        left.discard(peer)
                        logger.critical("%s is in reach and does not answer emergency stop %s.", peer, epoch)
                elif (peer, outcome) not in logged:
                    logged.add((peer, outcome))
                    why = explain(reply.get("result")) if "result" in reply else shown(reply.get("error"))
                    logger.critical("%s is in reach and did NOT stop on emergency stop %s: %s", peer, epoch, why)

    def _ask(self, peer: str, stop: dict[str, Any]) -> dict[str, Any]:
        replies = self._requester.stop_each(lambda: {peer: stop}, RETRY_ANSWER_S, lambda replies: not replies)
        return next(iter(replies), {"status": "timeout"})

    def _seen_since(self, began: float, peer: str) -> bool:
        row = self._context.registry.get(peer, self._context.monotonic() - began)
        return row is not None and bool(row["reachable"])
