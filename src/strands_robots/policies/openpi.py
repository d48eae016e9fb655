"""A policy server that speaks openpi's protocol: MessagePack on a WebSocket.

The server speaks first, with a map of metadata that may be empty. Then each observation, one map, is answered by one
map with ``actions``: (horizon, dimension), in the policy's units. An error is a text frame, and the server closes.
Arrays are maps with the binary keys ``__ndarray__``, ``data``, ``dtype`` and ``shape``, scalars of numpy maps with
``__npgeneric__``, ``dtype`` and a plain number as ``data``. Source: openpi's
``msgpack_numpy.py`` and ``websocket_policy_server.py``; vLLM-Omni's variant adds a batch axis and errors as maps.

There are no ids: after a missed deadline the connection is dropped, or the late answer would be taken for the next one.
An inference blocks the server, pings too, so this client sends none.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from strands_robots.policies.base import Action
from strands_robots.policies.policy_server import (
    ANSWER_MAX,
    PolicyServerError,
    ServedPolicy,
    actions_of,
    compare,
    picture_key,
    wait_for_answer,
)
from strands_robots.policies.profiles import Profile
from strands_robots.policies.warm import WarmModels
from strands_robots.utils import ValidationError, optional_module, shown

_module = partial(optional_module, what="The openpi policy", extra="remote")

LAYOUTS = ("libero", "droid", "aloha")
DROID_JOINTS = 7

_CLOSE_S = 0.5
_KINDS = "biuf"
"""Kinds of numpy arrays that are decoded; objects, records and complex numbers are refused."""


class OpenPiConnection:
    """One connection to a server; used by one policy at a time."""

    def __init__(self, profile: Profile, token: str) -> None:
        self._profile = profile
        self._token = token
        self._socket: Any = None
        self._open_socket = contextlib.ExitStack()
        self._gone = (_module("websockets.exceptions").WebSocketException, OSError)
        self.metadata: Mapping[str, Any] = {}

    def open(self, deadline: float, interrupted: threading.Event) -> None:
        """Connect and take the server's metadata.

        Raises:
            PolicyServerError: no server answers.
        """
        self.close()
        headers = {"Authorization": f"Api-Key {self._token}"} if self._token else {}
        try:
            self._socket = self._open_socket.enter_context(
                _module("websockets.sync.client").connect(
                    self._profile.url,
                    additional_headers=headers,
                    open_timeout=max(0.01, deadline - time.monotonic()),
                    close_timeout=_CLOSE_S,
                    ping_interval=None,
                    compression=None,
                    proxy=None,
                    max_size=ANSWER_MAX,
                )
            )
            self.metadata = self._receive(deadline, interrupted)
        except self._gone as exc:
            raise PolicyServerError(f"no policy server answers at {self._profile.url}: {exc}") from exc

    def infer(self, observation: Mapping[str, Any], deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        """Return the answer to an observation, on a new connection if need be."""
        frame = _module("msgpack").packb(observation, default=_encoded)
        if self._socket is None:
            self.open(deadline, interrupted)
        try:
            return self._asked(frame, deadline, interrupted)
        except self._gone:
            self.open(deadline, interrupted)
        try:
            return self._asked(frame, deadline, interrupted)
        except self._gone as exc:
            raise PolicyServerError(f"the policy server at {self._profile.url} was lost: {exc}") from exc

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        self._socket = None
        with contextlib.suppress(*self._gone):
            self._open_socket.close()

    def _asked(self, frame: bytes, deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        self._socket.send(frame)
        return self._receive(deadline, interrupted)

    def _receive(self, deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        socket = self._socket
        frame = wait_for_answer(
            self._profile.url, lambda left: socket.recv(timeout=left), deadline, interrupted, self.close
        )
        if isinstance(frame, str):
            self.close()
            last = frame.strip().splitlines()[-1] if frame.strip() else "an empty error"
            raise PolicyServerError(f"the policy server at {self._profile.url} failed: {last}")
        return _decoded(frame)


class OpenPiPolicy(ServedPolicy):
    """Policy on an openpi server; the profile's ``layout`` names the keys of the observation.

    Raises:
        ValidationError: also a layout that the profile's state does not fit.
    """

    provider = "openpi"
    connections = WarmModels()

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
        pictures = {each.key: seen[picture_key(each)] for each in profile.cameras}
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
        chunk = _module("numpy").asarray(answer["actions"])
        batched = chunk.ndim == 3 and chunk.shape[0] == 1
        return actions_of(chunk[0] if batched else chunk, self.profile.action)


def _encoded(value: Any) -> Any:
    """Return an array as openpi's map of binary keys."""
    if getattr(value, "ndim", None):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": list(value.shape)}
    raise TypeError(f"an observation cannot have {shown(value)}")


def _decoded(frame: bytes) -> dict[str, Any]:
    try:
        answer = _module("msgpack").unpackb(frame, object_hook=_array, strict_map_key=False)
    except (ValueError, TypeError, KeyError, OverflowError, SyntaxError, RecursionError) as exc:
        # numpy.dtype raises SyntaxError for some texts that are no type.
        raise PolicyServerError(f"the policy server sent a frame that cannot be read: {exc}") from exc
    if not isinstance(answer, dict):
        raise PolicyServerError(f"the policy server answered {shown(answer)}")
    return {
        key.decode("utf-8", "replace") if isinstance(key, bytes) else str(key): each for key, each in answer.items()
    }


def _array(found: dict[Any, Any]) -> Any:
    """Decode openpi's arrays and scalars.

    Raises:
        ValueError: an array of objects, or one whose bytes do not fill its shape.
    """
    numpy = _module("numpy")
    if not (b"__ndarray__" in found or b"__npgeneric__" in found):
        return found
    dtype = numpy.dtype(found[b"dtype"])
    if dtype.kind not in _KINDS:
        raise ValidationError(f"an array of the kind {dtype.kind}")
    if b"__npgeneric__" in found:
        return dtype.type(found[b"data"]).item()
    return numpy.frombuffer(found[b"data"], dtype).reshape(tuple(int(each) for each in found[b"shape"]))
