"""First epochs of control leases, above those of every earlier process.

An operator's assertion names the epoch of the lease that it ends. The epoch rises with each holder, and a restarted
process begins above all epochs of the one before, so that a recorded assertion never fits again. Neither a clock that
is set back nor a second process with the same state directory changes that. The file ``control-epochs`` there
has one byte for each robot that ever reserved its first epoch; the byte's place is the high part of the epoch. The low
part is random, so that a state directory that was lost or put back does not bring an epoch back either.
"""

from __future__ import annotations

import os
import secrets
import threading
from collections.abc import Callable
from contextlib import suppress

from strands_robots.serving.workers import BoundedCall
from strands_robots.state_files import adopt, make_private, read_private, require_private, state_dir
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

EPOCHS_EACH = 2**28
"""Epochs from one reservation to the next; the first half is where a lease may begin."""


def reserve_epochs() -> int:
    """Return an epoch above all that were ever reached here, kept on the disk.

    Raises:
        OSError: the state directory cannot be written.
        StateFileError: it, or the file, is not this user's alone.
    """
    root = state_dir()
    path = root / "control-epochs"
    adopt(root)
    make_private(root)
    require_private(root, root)
    with suppress(FileNotFoundError):
        read_private(path, root, longest=0)
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        os.write(descriptor, b".")
        os.fsync(descriptor)
        # Appending is atomic: no other process ends its byte at this place.
        place = os.lseek(descriptor, 0, os.SEEK_CUR)
    finally:
        os.close(descriptor)
    return place * EPOCHS_EACH + secrets.randbelow(EPOCHS_EACH // 2)


class FirstEpoch:
    """First epoch of the leases of one robot, 0 until it is reserved; thread-safe.

    Args:
        reserve: returns it; :func:`reserve_epochs` by default.
    """

    def __init__(self, reserve: Callable[[], int] = reserve_epochs) -> None:
        self._reserve = BoundedCall(reserve)
        self._changing = threading.Lock()
        self.value = 0

    def reserved(self, within: float) -> str | None:
        """Reserve it unless that is done; return what prevents it, or None.

        A disk that hangs is waited for at most ``within`` seconds.
        """
        if self.value:
            return None
        try:
            value = self._reserve(within)
        except (OSError, ValueError, RuntimeError) as exc:
            return f"{type(exc).__name__}: {exc}"
        with self._changing:
            self.value = self.value or value
        return None
