"""Client of a policy server on a WebSocket, which answers observations with actions.

Every message is an object, as a JSON text frame or a MessagePack binary frame; the server answers with the same kind.
The robot sends requests with an ``id`` that the answer repeats:

* ``{"id", "type": "reset", "instruction", "action_keys", "ranges"}``, answered by ``{"id", "type": "ready"}``;
  ``ranges`` holds ``[low, high]`` of every key that has a range.
* ``{"id", "type": "act", "observation"}``, answered by ``{"id", "type": "actions", "actions", "done"}``; each action
  is ``{key: target}`` and is played for one control step; then the robot asks again. ``done`` ends the task after them.

Anything may be answered by ``{"id", "type": "error", "reason"}``. An image, in MessagePack frames alone, is
``{"shape", "dtype", "data"}`` with its bytes in C order. ``examples/policy_server.py`` is the reference server.
The connection is neither encrypted nor authenticated: use a tunnel to a server on another machine.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping
from functools import partial
from typing import Any, NoReturn

from strands_robots.policies.base import Action, Ranges, checked_action, numbers
from strands_robots.policies.decoding import ForeignDataError, decode_json, decode_msgpack
from strands_robots.policies.policy_server import CHUNK_MAX, SLICE_S, PolicyServerError, ServerSocket
from strands_robots.utils import ValidationError, choice, dial_host_error, flag, number, optional_module, shown, whole

_module = partial(optional_module, what="The remote policy", extra="remote")

DEFAULT_PORT = 8765


class RemotePolicy:
    """Policy that asks a policy server for every chunk of actions.

    A lost connection is opened again and the task sent again within the deadline of the step that noticed.

    Args:
        policy_host: a bare hostname or IP address.
        policy_port: 1 to 65535; 0 for :data:`DEFAULT_PORT`.
        deadline_s: longest step, reconnecting included, 0.01 to 60 s.
        reset_deadline_s: longest time for connecting and the answer to ``reset``, 0.1 to 600 s.
        frames: ``json`` or ``msgpack``.
        uses_cameras: send images too; with ``msgpack`` only.

    Raises:
        ValidationError: an argument outside its domain.
        MissingExtraError: the [remote] extra is not installed.
    """

    def __init__(
        self,
        policy_host: str = "127.0.0.1",
        policy_port: int = 0,
        *,
        deadline_s: float = 1.0,
        reset_deadline_s: float = 10.0,
        frames: str = "json",
        uses_cameras: bool = False,
    ) -> None:
        reason = dial_host_error(policy_host)
        if reason is not None:
            raise ValidationError(f"policy_{reason}")
        host = f"[{policy_host}]" if ":" in policy_host and not policy_host.startswith("[") else policy_host
        self.url = f"ws://{host}:{whole('policy_port', policy_port, low=0, high=65535) or DEFAULT_PORT}"
        self.uses_cameras = flag("uses_cameras", uses_cameras)
        packed = choice("frames", frames, ("json", "msgpack")) == "msgpack"
        if uses_cameras and not packed:
            raise ValidationError("frames must be msgpack for images, not 'json'.")
        self._deadline_s = number("deadline_s", deadline_s, low=0.01, high=60)
        self._reset_s = number("reset_deadline_s", reset_deadline_s, low=0.1, high=600)
        self._socket = ServerSocket(self.url)
        self._msgpack = _module("msgpack")
        self._packed = packed
        self._task: dict[str, Any] = {}
        self._ranges: Ranges = {}
        self._last_id = 0
        self._done = False
        self._interrupted = threading.Event()

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._ranges = ranges
        self._done = False
        finite = {key: list(pair) for key, pair in ranges.items() if math.isfinite(pair[1] - pair[0])}
        self._task = {"type": "reset", "instruction": instruction, "action_keys": list(ranges), "ranges": finite}
        try:
            self._open(time.monotonic() + self._reset_s)
        except self._socket.lost as exc:
            raise PolicyServerError(f"no policy server answers at {self.url}: {exc!s:.200}") from exc

    def act(self, observation: Mapping[str, Any]) -> list[Action] | None:
        if self._done:
            return None
        deadline = time.monotonic() + self._deadline_s
        request = {"type": "act", "observation": self._encoded_observation(observation)}
        try:
            answer = self._request(request, deadline)
        except self._socket.lost:
            try:
                self._open(deadline)
                answer = self._request(request, deadline)
            except self._socket.lost as exc:
                raise PolicyServerError(f"the policy server at {self.url} was lost: {exc!s:.200}") from exc
        return self._actions(answer)

    def interrupt(self) -> None:
        self._interrupted.set()

    def close(self) -> None:
        self._socket.close()

    def _open(self, deadline: float) -> None:
        self._socket.open(deadline)
        answer = self._request(self._task, deadline)
        if answer.get("type") != "ready":
            self._refuse(answer)

    def _request(self, message: Mapping[str, Any], deadline: float) -> dict[str, Any]:
        self._last_id += 1
        self._socket.send(self._encoded({"id": self._last_id, **message}), deadline)
        while True:
            left = deadline - time.monotonic()
            if self._interrupted.is_set():
                raise PolicyServerError("interrupted, because the task was stopped")
            if left <= 0:
                raise PolicyServerError(f"the policy server at {self.url} did not answer {message['type']} in time")
            try:
                frame = self._socket.receive(min(left, SLICE_S))
            except TimeoutError:
                continue
            answer = self._decoded(frame)
            # An answer to an older request, which timed out, is of no use any more.
            if answer.get("id") == self._last_id:
                break
        if answer.get("type") == "error":
            raise PolicyServerError(f"the policy server at {self.url} refused: {shown(answer.get('reason'))}")
        return answer

    def _actions(self, answer: dict[str, Any]) -> list[Action] | None:
        actions = answer.get("actions")
        if answer.get("type") != "actions" or not isinstance(actions, list) or len(actions) > CHUNK_MAX:
            self._refuse(answer)
        try:
            chunk = [checked_action(action, self._ranges) for action in actions]
        except ValidationError as exc:
            raise PolicyServerError(f"the policy server at {self.url} gave an unusable action: {exc}") from exc
        self._done = answer.get("done") is True
        return None if self._done and not chunk else chunk

    def _refuse(self, answer: object) -> NoReturn:
        raise PolicyServerError(f"the policy server at {self.url} answered {shown(answer)}")

    def _encoded_observation(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        encoded: dict[str, Any] = dict(numbers(observation))
        if self.uses_cameras:
            for key, value in observation.items():
                if getattr(value, "ndim", 0):
                    encoded[key] = {"shape": list(value.shape), "dtype": str(value.dtype), "data": value.tobytes()}
        return encoded

    def _encoded(self, message: Mapping[str, Any]) -> str | bytes:
        if not self._packed:
            return json.dumps(message, allow_nan=False)
        packed: bytes = self._msgpack.packb(message)
        return packed

    def _decoded(self, frame: str | bytes) -> dict[str, Any]:
        try:
            answer = decode_json(frame) if isinstance(frame, str) else decode_msgpack(frame)
        except ForeignDataError as exc:
            raise PolicyServerError(f"the policy server at {self.url} sent a frame that cannot be read: {exc}") from exc
        if not isinstance(answer, dict):
            self._refuse(answer)
        return answer
