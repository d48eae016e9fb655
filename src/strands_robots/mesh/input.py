"""Teleoperation over the mesh: leaders publish actions, followers apply them.

A frame on ``strands/PEER/input/DEVICE`` is ``peer_id``, ``device``, ``method``, ``t``, ``seq``, ``action`` (floats by
joint) and ``events`` (or null).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from strands_robots.mesh import topics
from strands_robots.mesh.input_receiver import InputMesh, InputReceiver
from strands_robots.mesh.security import check_input_key, validate_mesh_identifier
from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.wire import WireError
from strands_robots.moved import of_module
from strands_robots.teleoperators import teleop_events
from strands_robots.utils import ValidationError, number, shown, teleoperator_contract_error, text

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


__all__ = ["INPUT_HZ_DEFAULT", "InputPublisher", "InputReceiver", "MeshInputSink"]

logger = logging.getLogger(__name__)

INPUT_HZ_DEFAULT = 50.0
_INPUT_JOIN_TIMEOUT_S = 2.0
"""Seconds that a stop waits for the publishing loop."""
LOGGED_ERRORS = 5


class MeshInputSink:
    """Publishes the input frames of ``teleoperate(publish=True)``."""

    def __init__(self, mesh: InputMesh) -> None:
        self._mesh = mesh

    def publish(self, device: str, method: str, action: Mapping[str, float], events: Mapping[str, Any] | None) -> None:
        """Publish one frame. Raises TransportError or WireError."""
        if not self._mesh.alive:
            raise TransportError("the mesh is not running.")
        frame = {
            "peer_id": self._mesh.peer_id,
            "device": device,
            "method": method,
            "t": self._mesh.inputs.now(),
            "seq": self._mesh.inputs.next_number(device),
            "action": dict(action),
            "events": None if events is None else {str(key): bool(value) for key, value in events.items()},
        }
        self._mesh.publish(topics.input_stream(self._mesh.peer_id, device), self._mesh.inputs.sign(frame))


class InputPublisher:
    """Publishes the actions of a teleoperator at a fixed rate, on its own thread.

    Raises:
        ValidationError: ``device_name`` is no identifier.
        ValueError: ``hz`` is not positive and finite, or ``teleoperator`` has no ``get_action``.
    """

    def __init__(
        self,
        mesh: InputMesh,
        teleoperator: Any,
        device_name: str = "leader",
        method: str = "arm",
        hz: float = INPUT_HZ_DEFAULT,
    ) -> None:
        problem = teleoperator_contract_error(teleoperator)
        if problem is not None:
            raise ValueError(problem)
        self._mesh = mesh
        self._sink = MeshInputSink(mesh)
        self._teleoperator = teleoperator
        self._device = validate_mesh_identifier(device_name, "device_name")
        self._method = text("method", method, longest=64)
        self._hz = number("hz", hz, above=0)
        self._running = False
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._frames = self._errors = self._event_errors = 0
        self._left_out: list[str] = []
        self._started = self._ended = 0.0

    @property
    def topic(self) -> str:
        """The key this publisher writes to."""
        return topics.input_stream(self._mesh.peer_id, self._device)

    @property
    def device_name(self) -> str:
        return self._device

    @property
    def stats(self) -> dict[str, Any]:
        """Counters; ``running`` is the request, ``thread_alive`` the state of the loop."""
        thread = self._thread
        alive = thread is not None and thread.is_alive()
        end = time.monotonic() if self._running else self._ended
        elapsed = end - self._started
        return {
            "device": self._device,
            "method": self._method,
            "running": self._running,
            "thread_alive": alive,
            "frames": self._frames,
            "errors": self._errors,
            "event_read_errors": self._event_errors,
            "hz_actual": round(self._frames / elapsed, 2) if elapsed > 0 else 0.0,
            "hz_target": self._hz,
        }

    def start(self) -> None:
        """Start publishing; already running is fine.

        Raises:
            RuntimeError: the loop of an earlier start outlived its stop; :meth:`stop` again waits for it once more.
        """
        if self._running:
            return
        if self._thread is not None and self._thread.is_alive():
            raise RuntimeError(f"{self.topic}: the loop of the last start still waits for its leader; stop it again.")
        self._running = True
        self._stopping = threading.Event()
        self._frames = self._errors = self._event_errors = 0
        self._started = time.monotonic()
        self._thread = threading.Thread(
            target=self._publish_loop, args=(self._stopping,), name=f"mesh-input-{self._device}", daemon=True
        )
        self._thread.start()
        self._mesh.inputs.announce(self._device, self._method, self._hz)

    def stop(self) -> dict[str, Any]:
        """Stop, wait at most 2 s for the loop, and return the counters."""
        if self._running:
            self._running, self._ended = False, time.monotonic()
            self._mesh.inputs.announce(self._device, None, 0)
        self._stopping.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(_INPUT_JOIN_TIMEOUT_S)
            if thread.is_alive():
                logger.warning("%s: the publishing loop outlived its stop; it may send one more frame.", self.topic)
        return self.stats

    def _publish_loop(self, stopping: threading.Event) -> None:
        period, due = 1.0 / self._hz, time.monotonic()
        while not stopping.is_set():
            self._publish_one()
            due += period
            left = due - time.monotonic()
            if left < 0:
                due -= left  # a late frame shifts the next ones: no burst follows
            elif stopping.wait(left):
                return

    def _publish_one(self) -> None:
        try:
            action = self._normalised(self._teleoperator.get_action())
            self._sink.publish(self._device, self._method, action, self._events())
        except (TransportError, WireError) as exc:
            self._note(f"not published: {exc}")
        except Exception as exc:  # noqa: BLE001 - a device raises what it likes; the loop counts it and goes on
            self._note(f"{type(exc).__name__}: {exc}")
        else:
            self._frames += 1

    def _normalised(self, action: object) -> dict[str, float]:
        """Return the action as floats by joint. Raises ValidationError without any."""
        if not isinstance(action, Mapping):
            raise ValidationError(f"action must be an object of numbers by joint, not {shown(action)}.")
        joints = {str(key): number for key, value in action.items() if (number := _float(value)) is not None}
        left_out = sorted(str(key) for key in action if str(key) not in joints)
        if not joints:
            raise ValidationError(f"action must hold a finite number for at least one joint, not {shown(action)}.")
        for key in joints:
            check_input_key(key)
        if left_out and left_out != self._left_out:
            logger.warning("%s: no finite numbers, left out of the frames: %s", self.topic, ", ".join(left_out))
            self._left_out = left_out
        return joints

    def _events(self) -> dict[str, Any] | None:
        try:
            return teleop_events(self._teleoperator)
        except Exception as exc:  # noqa: BLE001 - counted and logged; the action is still good
            self._event_errors += 1
            if self._event_errors <= LOGGED_ERRORS:
                logger.warning("%s: events could not be read: %s: %s", self.topic, type(exc).__name__, exc)
            return None

    def _note(self, problem: str) -> None:
        self._errors += 1
        if self._errors <= LOGGED_ERRORS:
            logger.warning("%s: %s", self.topic, problem)


def _float(value: Any) -> float | None:
    """Return a number, or an array's one element, as a finite float, else None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
        while isinstance(value, list) and len(value) == 1:
            value = value[0]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None
