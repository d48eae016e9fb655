"""The control lease of a caller: acquired, renewed in the background, released."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from strands_robots.envelope import Envelope
from strands_robots.errors import ControlError, NoAnswerError, RefusalError

logger = logging.getLogger(__name__)

RENEWALS = 3
"""Renewals in the time of a lease."""

RENEWED_S = 5.0
"""Seconds at most in which a renewal or the release has to be answered."""

Call = Callable[[str, Mapping[str, Any], float], Envelope]
"""Calls a verb of the robot with arguments within a time; raises :class:`RefusalError`."""


class HeldLease:
    """A lease that is renewed until :meth:`release`.

    Args:
        robot: its id, for the log.
        call: calls the robot.
        lease_id: the secret that the robot gave.
        ttl_s: seconds after which the robot ends the lease of a silent holder.
    """

    def __init__(self, robot: str, call: Call, lease_id: str, ttl_s: float) -> None:
        self.lease_id = lease_id
        self._robot, self._call, self._ttl_s = robot, call, ttl_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._renew, name=f"fleet-lease {robot}", daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Free the robot for others; a lease that is not released ends by itself."""
        self._over.set()
        try:
            self._call("releaseControl", {"lease_id": self.lease_id}, min(RENEWED_S, self._ttl_s))
        except RefusalError as exc:
            logger.warning("%s: its control lease was not released and ends by itself: %s", self._robot, exc)
        self._thread.join(RENEWED_S)

    def _renew(self) -> None:
        pause = self._ttl_s / RENEWALS
        while not self._over.wait(pause):
            try:
                self._call("renewControl", {"lease_id": self.lease_id}, min(RENEWED_S, pause))
            except NoAnswerError as exc:
                logger.debug("%s: a renewal is tried again: %s", self._robot, exc)
            except ControlError as exc:
                # The next motion carries the lease all the same: the robot's refusal says who holds it.
                logger.warning("%s: its control lease is lost: %s", self._robot, exc)
                return
            except RefusalError as exc:
                logger.warning("%s: its control lease could not be renewed: %s", self._robot, exc)


class SharedLease:
    """Lease that all blocks of one robot share; the last block releases it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: HeldLease | None = None
        self._blocks = 0

    @property
    def lease_id(self) -> str:
        """The secret of the lease that is held now; empty without one."""
        held = self._held
        return "" if held is None else held.lease_id

    @contextmanager
    def block(self, acquire: Callable[[], HeldLease]) -> Iterator[None]:
        """Hold the lease for the block, acquired by ``acquire`` where none is held."""
        with self._lock:
            if self._held is None:
                self._held = acquire()
            self._blocks += 1
        try:
            yield
        finally:
            # A block that begins meanwhile waits for the release, so that it is not refused for our own lease.
            with self._lock:
                self._blocks -= 1
                held = self._held
                if held is not None and not self._blocks:
                    self._held = None
                    held.release()
