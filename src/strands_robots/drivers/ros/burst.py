"""One drive: so many velocity messages at a rate, and one zero after them whatever happened."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from strands_robots.drivers.ros.wire import VelocityWire
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import Permit, PermitVoidError
from strands_robots.utils import ValidationError

COUNT_MAX = 10**12
"""Most messages of one drive: three hundred years at 100 Hz, and still a number that every sentence can carry."""


def messages_for(name: str, seconds: float, rate_hz: float) -> int:
    """How many messages hold a velocity for so long. Raises :class:`ValidationError` beyond :data:`COUNT_MAX`."""
    wanted = seconds * rate_hz
    if wanted > COUNT_MAX:
        most = COUNT_MAX / rate_hz
        raise ValidationError(f"{name} must be at most {most:g} s at {rate_hz:g} Hz, not {seconds:g}.")
    return max(1, round(wanted))


class Order(NamedTuple):
    """A checked drive: velocities as sent (m/s, rad/s), the message that carries them, how often and how fast."""

    linear: float
    angular: float
    fields: Mapping[str, Any]
    messages: int
    rate_hz: float
    latches: bool
    zero: bool

    @property
    def trailing_zero(self) -> bool:
        """A bare single shot latches, as a raw command does; zeros need no zero after them."""
        return not (self.latches or self.zero)


class Burst:
    """Sends an order under a permit. :meth:`run` once, on any thread; :meth:`interrupt` from any other."""

    policy = "drive"

    def __init__(self, order: Order, wire: VelocityWire, permit: Permit) -> None:
        self.order = order
        self.state = "running"
        self.answer: Envelope | None = None
        self.sent = 0
        self.ended = threading.Event()
        """Set by whoever runs it, once the base is free for the next drive."""
        self._began = time.monotonic()
        self._took_s: float | None = None
        self._wire = wire
        self._permit = permit
        self._stopped = threading.Event()

    @property
    def instruction(self) -> str:
        """The drive in a few words."""
        return f"drive {self.order.linear:g} m/s, {self.order.angular:g} rad/s"

    @property
    def velocities(self) -> Mapping[str, float]:
        """What was ordered, in m/s and rad/s."""
        return {"linear": self.order.linear, "angular": self.order.angular}

    @property
    def elapsed_s(self) -> float:
        """Seconds since the drive was ordered; once it has ended, how long it took."""
        return time.monotonic() - self._began if self._took_s is None else self._took_s

    def interrupt(self) -> None:
        """Send nothing more but the zero."""
        self._stopped.set()

    def never_began(self, why: str) -> Envelope:
        """In place of :meth:`run`: nothing was sent, for this reason."""
        self.state = "error"
        self.answer = error(f"The drive could not begin: {why}.", messages=0)
        self._took_s = 0.0
        return self.answer

    def run(self) -> Envelope:
        """Send, and answer how it went; the answer is kept in ``answer``."""
        problem, halt_problem = "", ""
        try:
            self._send_all()
        except PermitVoidError:
            self.state = "stopped"
        except Exception as exc:  # noqa: BLE001 - whatever the link raises, the zero still goes out and the answer says so
            problem = str(exc) or type(exc).__name__
        except BaseException:
            problem = "it was interrupted"
            raise
        finally:
            # In a finally, so that a Ctrl-C inside the burst leaves no velocity behind either.
            if self.order.trailing_zero:
                halt_problem = self._halt()
            self.answer = self._answered(problem, halt_problem)
            self._took_s = time.monotonic() - self._began
        return self.answer

    def _send_all(self) -> None:
        period_s = 1 / self.order.rate_hz
        due = time.monotonic()
        for _ in range(self.order.messages):
            self._wire.send(self.order.fields, self._permit)
            self.sent += 1
            # A late message is not made up for: a burst would come faster than the rate.
            due = max(due + period_s, time.monotonic())
            if self.order.latches:
                return
            if self._stopped.wait(min(due - time.monotonic(), threading.TIMEOUT_MAX)):
                raise PermitVoidError("the drive was stopped")

    def _halt(self) -> str:
        try:
            self._wire.zero()
        except Exception as exc:  # noqa: BLE001 - a zero that failed turns the whole answer into an error
            return str(exc) or type(exc).__name__
        return ""

    def _answered(self, problem: str, halt_problem: str) -> Envelope:
        order = self.order
        fields: dict[str, Any] = {
            "linear": order.linear,
            "angular": order.angular,
            "messages": self.sent,
            "trailing_zero": order.trailing_zero and not halt_problem,
        }
        said = []
        if self.state == "stopped":
            said.append(f"A stop ended the drive after {self.sent} of {order.messages} messages")
        if problem:
            said.append(f"the drive failed after {self.sent} of {order.messages} messages: {problem}")
        if halt_problem:
            said.append(f"the zero that ends the drive failed, so the base may still move: {halt_problem}")
        if said:
            self.state = "error" if problem or halt_problem else self.state
            sentence = "; ".join(said).rstrip(".")
            return error(f"{sentence[0].upper()}{sentence[1:]}.", **fields)
        self.state = "completed"
        held = " It goes on until it is stopped." if order.latches and not order.zero else ""
        return success(
            f"Sent {self.sent} messages of {order.linear:g} m/s and {order.angular:g} rad/s.{held}", **fields
        )
