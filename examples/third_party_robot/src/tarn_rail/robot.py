"""The rail as a robot: a carriage that goes to a place, and shuttles between the ends."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated

from strands_robots import Domain, Permit, verb
from strands_robots.envelope import Envelope, error, success
from strands_robots.utils import ValidationError
from tarn_rail.link import ANSWER_S, RailError, RailLink

LENGTH_MM = 1200.0
LOOK_S = 0.05
STOP_S = 0.7
"""Seconds that a halt may take with all its attempts; the deadline of a halt is 1 s."""

STILL_S, STILL_MM = 0.03, 0.2
"""A carriage that stands has moved by less than so much after so long."""

Place = Annotated[float, Domain(0, LENGTH_MM, "mm")]
Speed = Annotated[float, Domain(1, 400, "mm/s")]


@dataclass(frozen=True)
class State:
    """State of the rail: ``IDLE``, ``MOVING``, ``HELD`` or ``FAULT``, and its position."""

    name: str
    position_mm: float

    @classmethod
    def of(cls, words: list[str]) -> State:
        """Read the answer to ``STATE`` or ``STOP``.

        Raises:
            RailError: it is none.
        """
        try:
            name, position = words
            return cls(name, float(position))
        except ValueError as exc:
            raise RailError(f"the answer {' '.join(words)!r} cannot be read") from exc


class TarnRail:
    """Carriage on a Tarn TR-12.

    Args:
        host: of the rail's controller, or of its emulator.
        port: TCP port of it.

    Raises:
        ConnectionError: there is no rail.
    """

    tool_name_str = "tarn-rail"

    def __init__(self, host: str = "127.0.0.1", port: int = 7812) -> None:
        self._link = RailLink(host, port)
        try:
            self._state()
        except RailError as exc:
            self._link.close()
            raise ConnectionError(f"There is no rail at {host}:{port}: {exc}.") from exc

    @verb(motion=True, lasts=300.0)
    def slide_to(self, position_mm: Place, permit: Permit, speed_mm_s: Speed = 100.0) -> dict[str, float]:
        """Move the carriage to a place.

        Args:
            position_mm: from the motor's end.
            speed_mm_s: of the carriage.
        """
        return {"position_mm": self._go(permit, [position_mm], speed_mm_s)}

    @verb(motion=True, lasts=600.0)
    def shuttle(self, trips: Annotated[int, Domain(1, 50)], permit: Permit) -> dict[str, float]:
        """Move the carriage from end to end.

        Args:
            trips: there and back again.
        """
        return {"position_mm": self._go(permit, [LENGTH_MM, 0.0] * trips, 200.0)}

    @verb(motion=True)
    def clear_fault(self, permit: Permit) -> None:
        """Clear the fault that an overload has left; look at the carriage first."""
        if self._state().name == "FAULT":
            self._link.ask("CLEAR", only_if=lambda: permit.valid)

    @verb(motion=False)
    def read_state(self) -> dict[str, object]:
        """Read the state of the rail and the position of the carriage."""
        state = self._state()
        return {"rail": state.name, "position_mm": state.position_mm}

    def get_features(self) -> Envelope:
        """Return the names of its joints, which need no rail."""
        axes = {"carriage_mm": "float"}
        return success("One axis.", observation_features=axes, action_features=axes)

    def get_state(self) -> Envelope:
        """Return the position of the carriage in mm."""
        try:
            state = self._state()
        except RailError as exc:
            return error(f"The rail was not read: {exc}.")
        return success(state.name, joints={"carriage_mm": state.position_mm})

    def halt(self, reason: str = "") -> Envelope:
        """Stop the carriage; say that it stands where the rail has said so, and it does.

        Args:
            reason: for the log of the caller.
        """
        ends, doubt = time.monotonic() + STOP_S, ""
        while (left := ends - time.monotonic()) > STILL_S:
            try:
                if not (doubt := self._stopped(min(left, ANSWER_S))):
                    return success("The carriage stands.", stopped=True)
            except RailError as exc:
                doubt = str(exc)
        return error(f"The carriage may move: {doubt}.", stopped=False)

    def cleanup(self) -> Envelope:
        """Stop the carriage and hang up."""
        verdict = self.halt("cleanup")
        self._link.close()
        return verdict

    def _stopped(self, within: float) -> str:
        """Send a stop; return the doubt that is left, or nothing."""
        first = State.of(self._link.ask("STOP", within=within) or [])
        time.sleep(STILL_S)
        after = State.of(self._link.ask("STATE", within=within) or [])
        if first.name == "MOVING" or after.name == "MOVING":
            return f"the rail says that it is {after.name}"
        if abs(after.position_mm - first.position_mm) > STILL_MM:
            return f"the rail says that it is {after.name}, and went on to {after.position_mm:g} mm"
        return ""

    def _state(self) -> State:
        return State.of(self._link.ask("STATE") or [])

    def _go(self, permit: Permit, places: list[float], speed: float) -> float:
        """Go to each place while the permit is valid; return the last position."""
        state = self._state()
        arrived = False
        try:
            for place in places:
                state = self._go_to(permit, place, speed)
                if not permit.valid:
                    break
            arrived = permit.valid
        finally:
            # The rail moves by itself: one that is not watched any more has to be told. A halt has done so already.
            if not arrived:
                self.halt("a motion has ended")
        return state.position_mm

    def _go_to(self, permit: Permit, place: float, speed: float) -> State:
        state = self._state()
        if state.name == "FAULT":
            raise ValidationError("The rail has a fault. Look at the carriage, then call clearFault.")
        if state.name == "HELD":  # every stop leaves that
            self._link.ask("RELEASE", only_if=lambda: permit.valid)
        # No stop can come between the look at the permit and the frame, for a stop is sent under the same lock.
        if self._link.ask("GO", f"{place:.1f}", f"{speed:.1f}", only_if=lambda: permit.valid) is None:
            return self._state()
        state = self._state()
        while permit.valid and state.name == "MOVING":
            time.sleep(LOOK_S)
            state = self._state()
        if permit.valid and state.name == "FAULT":
            raise ValidationError(f"The rail has a fault at {state.position_mm:g} mm. Look, then call clearFault.")
        if permit.valid and state.name == "HELD":
            raise ValidationError(f"The rail was stopped at {state.position_mm:g} mm, and not from here.")
        return state
