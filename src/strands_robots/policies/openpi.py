"""Client of a policy server with openpi's protocol: MessagePack on a WebSocket.

The server speaks first, with a map of metadata that may be empty. Then each observation, one map, is answered by one
map with ``actions``: (horizon, dimension), in the policy's units. An error is a text frame, and the server closes.
Arrays are maps with the binary keys ``__ndarray__``, ``data``, ``dtype`` and ``shape``; only the actions are decoded.
Source: openpi's ``msgpack_numpy.py`` and ``websocket_policy_server.py``; vLLM-Omni's variant adds a batch axis and
errors as maps.

There are no ids: after a missed deadline the connection is dropped, or the late answer would be taken for the next one.
An inference blocks the server, pings too, so this client sends none.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping
from functools import partial
from typing import Any

from strands_robots.policies.base import Action
from strands_robots.policies.decoding import ForeignDataError, decode_msgpack
from strands_robots.policies.policy_server import (
    PolicyServerError,
    ServedPolicy,
    ServerSocket,
    actions_of,
    compare,
    numbers_of,
    wait_for_answer,
)
from strands_robots.policies.preload import PreloadedModels
from strands_robots.policies.profiles import Profile
from strands_robots.utils import ValidationError, optional_module, shown

_module = partial(optional_module, what="The openpi policy", extra="remote")

_SHOWN = 400
"""Characters of a server's error that are looked at."""

LAYOUTS = ("libero", "droid", "aloha")
DROID_JOINTS = 7

_DTYPE = re.compile(r"[<>|=]?[biuf][1248]")
"""Types of numpy that are decoded; objects, texts, records and complex numbers are refused."""


class OpenPiConnection:
    """One connection to a server; used by one policy at a time."""

    def __init__(self, profile: Profile, token: str) -> None:
        self._url = profile.url
        self._socket = ServerSocket(profile.url, {"Authorization": f"Api-Key {token}"} if token else {})
        self.metadata: Mapping[str, Any] = {}

    def open(self, deadline: float, interrupted: threading.Event) -> None:
        """Connect and take the server's metadata.

        Raises:
            PolicyServerError: no server answers.
        """
        try:
            self._socket.open(deadline)
            self.metadata = self._receive(deadline, interrupted)
        except self._socket.lost as exc:
            raise PolicyServerError(f"no policy server answers at {self._url}: {exc!s:.200}") from exc

    def infer(self, observation: Mapping[str, Any], deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        """Return the answer to an observation, on a new connection if need be."""
        frame = _module("msgpack").packb(observation, default=_encoded)
        if not self._socket.is_open:
            self.open(deadline, interrupted)
        try:
            return self._asked(frame, deadline, interrupted)
        except self._socket.lost:
            self.open(deadline, interrupted)
        try:
            return self._asked(frame, deadline, interrupted)
        except self._socket.lost as exc:
            raise PolicyServerError(f"the policy server at {self._url} was lost: {exc!s:.200}") from exc

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        self._socket.close()

    def _asked(self, frame: bytes, deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        self._socket.send(frame, deadline)
        return self._receive(deadline, interrupted)

    def _receive(self, deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        frame = wait_for_answer(self._url, self._socket.receive, deadline, interrupted, self.close)
        where = f"the policy server at {self._url}"
        if isinstance(frame, str):
            self.close()
            last = frame[-_SHOWN:].strip().splitlines()[-1:] or ["an empty error"]
            raise PolicyServerError(f"{where} failed: {last[0]}")
        try:
            answer = decode_msgpack(frame)
        except ForeignDataError as exc:
            raise PolicyServerError(f"{where} sent a frame that cannot be read: {exc}") from exc
        if not isinstance(answer, dict):
            raise PolicyServerError(f"{where} answered {shown(answer)}")
        return {
            key.decode("utf-8", "replace") if isinstance(key, bytes) else str(key): each for key, each in answer.items()
        }


class OpenPiPolicy(ServedPolicy):
    """Policy on an openpi server; the profile's ``layout`` names its keys.

    Raises:
        ValidationError: also a layout that the profile's state does not fit.
    """

    provider = "openpi"
    connections = PreloadedModels()

    def __init__(self, profile: Profile | None = None) -> None:
        super().__init__(profile)
        self._layout = self.layout(LAYOUTS)
        if self._layout == "droid" and len(self.profile.state) != DROID_JOINTS + 1:
            raise ValidationError(
                f"profile {self.profile.name}: layout droid needs 8 keys in state, 7 joints and the gripper."
            )
        for module in ("websockets.sync.client", "msgpack", "numpy"):
            _module(module)

    def connect(self, token: str, deadline: float) -> OpenPiConnection:
        connection = OpenPiConnection(self.profile, token)
        connection.open(deadline, threading.Event())
        try:
            keys, horizon = connection.metadata.get("action_keys"), connection.metadata.get("action_horizon")
            if isinstance(keys, list):
                compare("action_keys", keys, list(self.profile.action))
            if isinstance(horizon, int) and self.profile.chunk is not None:
                compare("action_horizon", horizon, self.profile.chunk)
        except BaseException:
            connection.close()
            raise
        return connection

    def observation(self, seen: Mapping[str, Any], task: str) -> dict[str, Any]:
        numpy, profile = _module("numpy"), self.profile
        state = numpy.array([seen[key] for key in profile.state], numpy.float32)
        pictures = {each.key: seen[each.short_key] for each in profile.cameras}
        if self._layout == "aloha":
            first = {key: numpy.ascontiguousarray(numpy.transpose(image, (2, 0, 1))) for key, image in pictures.items()}
            return {"state": state, "images": first, "prompt": task}
        if self._layout == "droid":
            joints, gripper = state[:DROID_JOINTS], state[DROID_JOINTS:]
            parts = {"observation/joint_position": joints, "observation/gripper_position": gripper}
            return {**parts, **pictures, "prompt": task}
        return {"observation/state": state, **pictures, "prompt": task}

    def actions(self, answer: Mapping[str, Any]) -> list[Action]:
        if "actions" not in answer:
            problem = answer.get("message", answer.get("error", sorted(map(str, answer))))
            raise PolicyServerError(
                f"the policy server at {self.profile.url} answered without actions: {shown(problem)}"
            )
        chunk = _array(answer["actions"])
        batched = chunk.ndim == 3 and chunk.shape[0] == 1
        return actions_of(chunk[0] if batched else chunk, self.profile.action)


def _encoded(value: Any) -> Any:
    """Return an array as openpi's map of binary keys."""
    if getattr(value, "ndim", None):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": list(value.shape)}
    raise TypeError(f"an observation cannot have {shown(value)}")


def _array(found: Any) -> Any:
    """Decode an array of openpi's, or lists of numbers.

    Raises:
        PolicyServerError: it is neither, or its bytes do not fill its shape.
    """
    if not (isinstance(found, dict) and b"__ndarray__" in found):
        return numbers_of(found)
    dtype, shape, data = (found.get(part) for part in (b"dtype", b"shape", b"data"))
    dtype = dtype.decode("latin-1") if isinstance(dtype, bytes) else dtype
    try:
        if not (isinstance(dtype, str) and _DTYPE.fullmatch(dtype)):
            raise ValidationError(f"the type {shown(dtype)}")
        if not (isinstance(data, bytes) and isinstance(shape, list) and all(type(each) is int for each in shape)):
            raise ValidationError(f"the shape {shown(shape)}")
        return _module("numpy").frombuffer(data, dtype).reshape(shape)
    except (ValueError, TypeError, OverflowError) as exc:
        raise PolicyServerError(f"the policy server sent an array that cannot be read: {exc!s:.200}") from exc
