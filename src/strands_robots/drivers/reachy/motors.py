"""Torque: the mode of all motors, verified by asking back, and single motors by name, which nobody can verify."""

from __future__ import annotations

from strands_robots.drivers.reachy.connection import Connection
from strands_robots.drivers.reachy.motion import Motions
from strands_robots.drivers.reachy.rest import DaemonFault, RestClient
from strands_robots.drivers.reachy.transport import STOP_MOVE_SINCE
from strands_robots.envelope import Envelope, success
from strands_robots.utils import ValidationError, shown, text

MOTOR_IDS = {
    "body_rotation": 10,
    **{f"stewart_{leg}": 10 + leg for leg in range(1, 7)},
    "right_antenna": 17,
    "left_antenna": 18,
}
"""Names that the daemon knows, and the ids on the bus."""

_NAMES = {str(number): name for name, number in MOTOR_IDS.items()}


def selected(motor_ids: object) -> tuple[str, ...]:
    """Motor names of a comma list of names or bus ids; empty for all.

    Raises:
        ValidationError: no text, a part that is no motor, or a list that names none.
    """
    chosen = text("motor_ids", motor_ids, longest=200, empty=True)
    if not chosen:
        return ()
    parts = [part.strip() for part in chosen.split(",") if part.strip()]
    names = tuple(dict.fromkeys(_NAMES.get(part, part) for part in parts))
    unknown = [name for name in names if name not in MOTOR_IDS]
    if unknown or not names:
        known = ", ".join(f"{name} ({number})" for name, number in MOTOR_IDS.items())
        raise ValidationError(f"motor_ids must name motors of {known}, or be empty for all, not {shown(motor_ids)}.")
    return names


class Motors:
    """The motors of one robot."""

    def __init__(self, connection: Connection, motions: Motions) -> None:
        self._connection, self._motions = connection, motions
        self._singled = False

    def mode(self, rest: RestClient | None = None, within_s: float | None = None) -> str:
        """enabled, disabled or gravity_compensation, as the daemon says now. Raises :class:`DaemonError`."""
        answer = (rest or self._connection.rest).get("/api/motors/status", within_s)
        mode = str(answer.get("mode")) if isinstance(answer, dict) else "unknown"
        self._connection.note_mode(mode)
        return mode

    def set_mode(self, mode: str) -> None:
        """Set the mode of all motors and make sure of it. Raises :class:`DaemonError`."""
        info = self._connection.info
        if mode == "enabled" and self._singled and info is not None and not info.since(STOP_MOVE_SINCE):
            # Before 1.10 a robot ignored this after torque was set motor by motor, unless all were off in between.
            self._connection.rest.post("/api/motors/set_mode/disabled")
        self._set(mode, self._connection.rest)
        self._singled = False

    def release(self, within_s: float = 1.0) -> None:
        """Switch all motors off, for an emergency stop: no turn, no permit, its own connection."""
        self._set("disabled", self._connection.stop_rest, within_s)

    def _set(self, mode: str, rest: RestClient, within_s: float | None = None) -> None:
        rest.post(f"/api/motors/set_mode/{mode}", within_s=within_s)
        now = self.mode(rest, within_s)
        if now != mode:
            raise DaemonFault(f"the motors were to be {mode} and are {now}.")

    def torque(self, on: bool, motor_ids: str, name: str) -> Envelope:
        """Torque on or off, of all motors or of some; ``name`` is the verb that asked."""
        names, mode = selected(motor_ids), "enabled" if on else "disabled"
        if not names:
            self._motions.torque(lambda: self.set_mode(mode), name)
            return success(f"All motors are {mode}.", motors="all", motor_mode=mode, verified=True)

        def change() -> None:
            self._connection.link().send_torque(on, names)
            self._singled = True

        self._motions.torque(change, name)
        return success(
            f"Asked for {', '.join(names)} {mode}; the daemon tells nobody the torque of a single motor.",
            motors=list(names),
            verified=False,
        )
