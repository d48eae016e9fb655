"""Leader arm on a bus of its own, read again after a lost answer."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from strands_robots.bus_access import bus_lock
from strands_robots.hardware._compat import drop, forget_input
from strands_robots.hardware.body import DeviceBody
from strands_robots.policies.base import Action

READ_TRIES = 3
"""Joint reads that fail before a frame counts as unusable; LeRobot waits 50 ms for each answer."""


class LeaderArm:
    """A LeRobot leader, connected without a prompt while it is entered as a context.

    Args:
        device: has ``connect``, ``disconnect`` and ``get_action``; its joints are moved by hand.
    """

    def __init__(self, device: Any) -> None:
        self.device = device
        self._lock = bus_lock(device)

    @property
    def is_connected(self) -> bool:
        """The device's own state; a device without one counts as connected."""
        return bool(getattr(self.device, "is_connected", True))

    def __enter__(self) -> Self:
        DeviceBody.bring_up(self.device)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.device.disconnect()
        except OSError:
            # Its cable is out, or a servo does not answer.
            drop(self.device)

    def get_action(self) -> Action:
        """Read the joints by action key; raise after three lost answers."""
        with self._lock:
            for left in reversed(range(READ_TRIES)):
                # A late answer would be taken for this one's, and every read after it would be old.
                forget_input(self.device)
                try:
                    return dict(self.device.get_action())
                except ConnectionError:
                    if not left:
                        raise
        raise AssertionError  # the last try returns or raises

    def get_teleop_events(self) -> dict[str, Any] | None:
        """Read the device's events besides its joints; None for a device without any."""
        read = getattr(self.device, "get_teleop_events", None)
        return dict(read()) if callable(read) else None
