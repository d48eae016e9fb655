"""A leader arm on a motor bus of its own, read as a follower is: one lost answer is no lost beat."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from strands_robots.bus_access import bus_lock
from strands_robots.hardware._compat import drop, forget_input
from strands_robots.hardware.body import DeviceBody
from strands_robots.policies.base import Action

READ_TRIES = 3
"""How often the joints are asked for before a frame counts as unusable; LeRobot waits 50 ms for each answer."""


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
        """What the device says; a device that says nothing counts as connected."""
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
            # Its cable is out, or a servo silent: there is nothing left to say goodbye to.
            drop(self.device)

    def get_action(self) -> Action:
        """Where the arm is held, by action key. Raises what the device raises when it does not answer thrice."""
        with self._lock:
            for left in reversed(range(READ_TRIES)):
                # An answer that came late would be taken for this one's, and every read after it be old.
                forget_input(self.device)
                try:
                    return dict(self.device.get_action())
                except ConnectionError:
                    if not left:
                        raise
        raise AssertionError  # the last try returns or raises

    def get_teleop_events(self) -> dict[str, Any] | None:
        """What the device tells besides its joints, where it does."""
        read = getattr(self.device, "get_teleop_events", None)
        return dict(read()) if callable(read) else None
