"""A policy server that speaks openpi's protocol: MessagePack on a WebSocket.

The server speaks first, with a map of metadata that may be empty. Then each observation, one map, is answered by one
map with ``actions``: (horizon, dimension), in the policy's units. An error is a text frame, and the server closes.
Arrays are maps with the binary keys ``__ndarray__``, ``data``, ``dtype`` and ``shape``. Source: openpi's
``msgpack_numpy.py`` and ``websocket_policy_server.py``; vLLM-Omni's variant adds a batch axis and errors as maps.

There are no ids: after a missed deadline the connection is dropped, or the late answer would be taken for the next one.
An inference blocks the server, pings too, so this client sends none.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from strands_robots.policies.base import Action, PolicyError, Ranges
from strands_robots.policies.profiles import Profile
from strands_robots.policies.warm import WarmModels
from strands_robots.utils import ValidationError, missing_extra, shown

CHUNK_MAX = 10_000
ANSWER_MAX = 64 * 2**20
"""Longest accepted frame, in bytes."""

PICTURE = (224, 224)
"""Size of pictures in the first inference where the profile states none; the server resizes to it."""

DROID_JOINTS = 7

_SLICE_S = 0.05
_CLOSE_S = 0.5
_KINDS = "biuf"
"""Kinds of numpy arrays that are decoded; objects, records and complex numbers are refused."""


class OpenPiError(PolicyError):
    """The server refused, sent an unusable answer, or did not answer in time."""


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
            OpenPiError: no server answers.
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
            raise OpenPiError(f"no policy server answers at {self._profile.url}: {exc}") from exc

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
            raise OpenPiError(f"the policy server at {self._profile.url} was lost: {exc}") from exc

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        self._socket = None
        with contextlib.suppress(*self._gone):
            self._open_socket.close()

    def _asked(self, frame: bytes, deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        self._socket.send(frame)
        return self._receive(deadline, interrupted)

    def _receive(self, deadline: float, interrupted: threading.Event) -> dict[str, Any]:
        while True:
            left = deadline - time.monotonic()
            if interrupted.is_set() or left <= 0:
                self.close()
                why = "was not waited for, because the task was stopped" if left > 0 else "did not answer in time"
                raise OpenPiError(f"the policy server at {self._profile.url} {why}")
            try:
                frame = self._socket.recv(timeout=min(left, _SLICE_S))
            except TimeoutError:
                continue
            break
        if isinstance(frame, str):
            self.close()
            last = frame.strip().splitlines()[-1] if frame.strip() else "an empty error"
            raise OpenPiError(f"the policy server at {self._profile.url} failed: {last}")
        return _decoded(frame)


class OpenPiPolicy:
    """Policy that asks an openpi server for every chunk; its profile has everything.

    Args:
        profile: with the server's ``url``, and ``layout``, which names the keys of the observation.

    Raises:
        ValidationError: no profile, or a layout that the profile's state does not fit.
        MissingExtraError: the [remote] extra is not installed.
    """

    def __init__(self, profile: Profile | None = None) -> None:
        if profile is None or not profile.url:
            raise ValidationError("policy_provider openpi needs a profile with a url: serve the robot with --policies.")
        if profile.layout == "droid" and len(profile.state) != DROID_JOINTS + 1:
            raise ValidationError(
                f"profile {profile.name}: layout droid needs 8 keys in state, 7 joints and the gripper."
            )
        for module in ("websockets.sync.client", "msgpack", "numpy"):
            _module(module)
        self.uses_cameras = bool(profile.cameras)
        self._profile = profile
        self._key = (profile.name, profile.url)
        self._token = _token(profile)
        self._connection: OpenPiConnection | None = None
        self._task = ""
        self._interrupted = threading.Event()

    def warm(self) -> str | None:
        """Connect, and let the server compile; see :class:`Warmable`."""
        return _CONNECTIONS.warm(self._key, self._connect)

    def _connect(self) -> OpenPiConnection:
        """Return a connection on which one inference was made, and not played.

        Raises:
            OpenPiError: no answer, or one of another dimension than the profile's actions.
        """
        numpy, profile, never = _module("numpy"), self._profile, threading.Event()
        connection, deadline = OpenPiConnection(profile, self._token), time.monotonic() + profile.first_deadline_s
        connection.open(deadline, never)
        try:
            self._compare(connection.metadata)
            blank: dict[str, Any] = dict.fromkeys(profile.state, 0.0)
            for camera in profile.cameras:
                blank[_short(camera.key)] = numpy.zeros((*(camera.size or PICTURE), 3), numpy.uint8)
            task = profile.task or "stand still"
            self._actions(connection.infer(self._observation(blank, task), deadline, never))
        except BaseException:
            connection.close()
            raise
        return connection

    def _compare(self, metadata: Mapping[str, Any]) -> None:
        """Compare what the server states of itself with the profile."""
        keys, mine = metadata.get("action_keys"), list(self._profile.action)
        if isinstance(keys, list) and keys != mine:
            raise OpenPiError(f"the server's action_keys are {keys}, and the profile has {mine}")
        horizon = metadata.get("action_horizon")
        if isinstance(horizon, int) and self._profile.chunk not in (None, horizon):
            raise OpenPiError(
                f"the server's action_horizon is {horizon}, and the profile's chunk {self._profile.chunk}"
            )

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._task = instruction
        self._connection = _CONNECTIONS.take(self._key, self._connect)

    def act(self, observation: Mapping[str, Any]) -> list[Action]:
        if self._connection is None:
            raise OpenPiError("it was not reset")
        deadline = time.monotonic() + self._profile.deadline_s
        request = self._observation(observation, self._task)
        return self._actions(self._connection.infer(request, deadline, self._interrupted))

    def interrupt(self) -> None:
        self._interrupted.set()

    def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is None:
            return
        if self._interrupted.is_set():
            # An answer may be on its way.
            connection.close()
        _CONNECTIONS.give(self._key, connection)

    def _observation(self, seen: Mapping[str, Any], task: str) -> dict[str, Any]:
        """Return the observation under the keys of the profile's layout."""
        numpy, profile = _module("numpy"), self._profile
        state = numpy.array([seen[key] for key in profile.state], numpy.float32)
        pictures = {each.key: seen[_short(each.key)] for each in profile.cameras}
        if profile.layout == "aloha":
            first = {key: numpy.ascontiguousarray(numpy.transpose(image, (2, 0, 1))) for key, image in pictures.items()}
            return {"state": state, "images": first, "prompt": task}
        if profile.layout == "droid":
            joints, gripper = state[:DROID_JOINTS], state[DROID_JOINTS:]
            parts = {"observation/joint_position": joints, "observation/gripper_position": gripper}
            return {**parts, **pictures, "prompt": task}
        return {"observation/state": state, **pictures, "prompt": task}

    def _actions(self, answer: Mapping[str, Any]) -> list[Action]:
        """Return the chunk of an answer, by the profile's action keys."""
        if "actions" not in answer:
            problem = answer.get("message", answer.get("error", sorted(map(str, answer))))
            raise OpenPiError(f"the policy server at {self._profile.url} answered without actions: {shown(problem)}")
        numpy, keys = _module("numpy"), self._profile.action
        chunk = numpy.asarray(answer["actions"])
        if chunk.ndim == 3 and chunk.shape[0] == 1:
            chunk = chunk[0]
        if chunk.ndim != 2 or not 1 <= chunk.shape[0] <= CHUNK_MAX or chunk.shape[1] != len(keys):
            raise OpenPiError(
                f"the policy server answered actions of the shape {chunk.shape}, and the profile has {len(keys)} keys"
            )
        if chunk.dtype.kind not in "iuf" or not numpy.isfinite(chunk).all():
            raise OpenPiError("the policy server answered actions that are no finite numbers")
        return [dict(zip(keys, map(float, row), strict=True)) for row in chunk]


_CONNECTIONS = WarmModels()
"""Connections on which an inference was made, by profile and server."""


def _short(key: str) -> str:
    """Return the key under which :class:`ProfiledPolicy` hands a picture on."""
    return key.removeprefix("observation.images.")


def _token(profile: Profile) -> str:
    if not profile.token_file:
        return ""
    try:
        return Path(profile.token_file).expanduser().read_text(encoding="utf-8").strip()
    except OSError as exc:
        raise ValidationError(f"profile {profile.name}: token_file cannot be read: {exc.strerror}.") from None


def _encoded(value: Any) -> Any:
    """Return an array as openpi's map of binary keys."""
    if getattr(value, "ndim", None):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": list(value.shape)}
    raise TypeError(f"an observation cannot have {shown(value)}")


def _decoded(frame: bytes) -> dict[str, Any]:
    try:
        answer = _module("msgpack").unpackb(frame, object_hook=_array, strict_map_key=False)
    except (ValueError, TypeError, RecursionError) as exc:
        raise OpenPiError(f"the policy server sent a frame that cannot be read: {exc}") from exc
    if not isinstance(answer, dict):
        raise OpenPiError(f"the policy server answered {shown(answer)}")
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
    values = numpy.frombuffer(found[b"data"], dtype)
    if b"__npgeneric__" in found:
        return values[0].item()
    return values.reshape(tuple(int(each) for each in found[b"shape"]))


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as exc:
        raise missing_extra("The openpi policy", "remote") from exc
