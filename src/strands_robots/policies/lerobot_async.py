"""A server of LeRobot's asynchronous inference: pickles over gRPC.

``transport.AsyncInference`` has ``Ready`` and ``SendPolicyInstructions``, with which the client chooses what the server
loads, then ``SendObservations`` and ``GetActions`` for each chunk. Every message holds a pickle; answers are read by
:func:`read_actions` alone. Source: LeRobot 0.4.0 to 0.6.1, ``async_inference/policy_server.py`` and ``helpers.py``,
``transport/services.proto`` and ``transport/utils.py``.

Nothing is encrypted and nobody is asked who he is, and the server unpickles what it is sent. So it has to be on this
machine, or at the other end of a tunnel. It has one policy and one queue: it serves one robot at a time.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from strands_robots.policies.base import Action
from strands_robots.policies.pickled import ANSWER_MAX, UnreadablePickleError, pickled, read_actions
from strands_robots.policies.policy_server import (
    PolicyServerError,
    ServedPolicy,
    actions_of,
    compare,
    picture_key,
    wait_for_answer,
)
from strands_robots.policies.profiles import Profile
from strands_robots.policies.warm import WarmModels
from strands_robots.utils import ValidationError, is_loopback_host, optional_module, shown

_module = partial(optional_module, what="The lerobot_async policy", extra="lerobot-async")

PORT = 8080
SERVICE = "/transport.AsyncInference/"
PIECE = 2 * 2**20
"""Longest piece of an observation, in bytes; gRPC servers refuse messages of 4 MB."""

CHUNK = 100
"""Actions that are asked for where the profile states no ``chunk``."""

TASK = "task"
STATE, IMAGES = "observation.state", "observation.images."

_BEGIN, _MIDDLE, _END = 1, 2, 3
_serving: dict[str, LeRobotAsyncConnection] = {}
_serving_lock = threading.Lock()


class LeRobotAsyncConnection:
    """One channel to a server, which serves no other policy meanwhile.

    Raises:
        PolicyServerError: another policy of this process uses the server.
    """

    def __init__(self, profile: Profile) -> None:
        self._url = profile.url
        self._profile = profile.name
        self._steps = itertools.count()
        self.lost = False
        """True when an answer failed: the server may be another one by now, or have loaded another policy."""
        self._channel: Any = None
        with _serving_lock:
            other = _serving.setdefault(self._url, self)
        if other is not self:
            raise PolicyServerError(
                f"the policy server at {self._url} is in use by the profile {other._profile}; it serves one robot at "
                "a time"
            )

    def instruct(self, instructions: bytes, deadline: float) -> None:
        """Have the server load a policy.

        Raises:
            PolicyServerError: it does not answer, or cannot load it.
        """
        never = threading.Event()
        self._call("Ready", b"", deadline, never)
        self._call("SendPolicyInstructions", _field(1, instructions), deadline, never)

    def infer(self, observation: Mapping[str, Any], deadline: float, interrupted: threading.Event) -> Any:
        """Return the actions of an observation, which is sent as the next step.

        Raises:
            PolicyServerError: no answer in time, none at all, one that cannot be read, or one of another observation.
        """
        step, now = next(self._steps), time.time()
        # Without must_go an observation whose joints have hardly moved is dropped, and nothing is answered.
        state = {"timestamp": now, "timestep": step, "observation": dict(observation), "must_go": True}
        self._call("SendObservations", _pieces(pickled("TimedObservation", state)), deadline, interrupted)
        answer = self._call("GetActions", b"", deadline, interrupted)
        where = f"the policy server at {self._url}"
        if not answer:
            raise PolicyServerError(f"{where} answered no actions; why is in its own log alone")
        try:
            actions = read_actions(answer)
        except UnreadablePickleError as exc:
            raise PolicyServerError(f"{where} sent an unreadable answer: {exc}") from exc
        # Every client counts from 0; the server gives the first action the time of its observation.
        steps = [each.timestep for each in actions]
        if steps != list(range(step, step + len(steps))) or any(each.timestamp != now for each in actions[:1]):
            raise PolicyServerError(f"{where} answered another observation; it serves another client besides")
        return [each.values for each in actions]

    def close(self) -> None:
        """Drop the channel and leave the server to others."""
        with _serving_lock:
            if _serving.get(self._url) is self:
                del _serving[self._url]
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _call(self, method: str, message: Any, deadline: float, interrupted: threading.Event) -> bytes:
        """Return the bytes of an answer's only field; empty where it has none.

        Args:
            message: bytes, or an iterator of them.
        """
        grpc = _module("grpc")
        channel = self._open()
        kind = channel.unary_unary if isinstance(message, bytes) else channel.stream_unary
        call = kind(SERVICE + method).future(message, timeout=max(0.01, deadline - time.monotonic()))

        def receive(seconds: float) -> Any:
            try:
                return call.result(timeout=seconds)
            except grpc.FutureTimeoutError:
                raise TimeoutError from None

        try:
            answer: bytes = wait_for_answer(self._url, receive, deadline, interrupted, call.cancel)
        except grpc.RpcError as exc:
            raise PolicyServerError(self._failure(method, exc)) from exc
        return _first_field(answer)

    def _failure(self, method: str, exc: Any) -> str:
        code = exc.code().name
        if code == "DEADLINE_EXCEEDED":
            return f"the policy server at {self._url} did not answer in time"
        if code == "UNAVAILABLE":
            return f"no policy server answers at {self._url}: {shown(exc.details())}"
        return f"the policy server at {self._url} failed in {method}: {code}, {shown(exc.details())}"

    def _open(self) -> Any:
        if self._channel is None:
            address = urlsplit(self._url)
            host = f"[{address.hostname}]" if ":" in str(address.hostname) else address.hostname
            # An answer that claims to be packed is handed on as it is, and refused: it might unpack to gigabytes.
            options = [
                ("grpc.max_receive_message_length", ANSWER_MAX),
                ("grpc.per_message_decompression", 0),
                ("grpc.enable_http_proxy", 0),
            ]
            target = f"{host}:{address.port or PORT}"
            self._channel = _module("grpc").insecure_channel(target, options=options)
        return self._channel


class LeRobotAsyncPolicy(ServedPolicy):
    """Policy on LeRobot's async server, which loads what the profile says.

    Raises:
        ValidationError: also a server that is neither here nor behind a tunnel, an environment, or one name for two
            things.
    """

    provider = "lerobot_async"
    connections = WarmModels()

    def __init__(self, profile: Profile | None = None) -> None:
        super().__init__(profile)
        where = f"profile {self.profile.name}"
        address = urlsplit(self.profile.url)
        if address.scheme != "grpc" or not is_loopback_host(str(address.hostname)):
            raise ValidationError(
                f"{where}: url must be grpc:// on this machine, not {shown(self.profile.url)}: the server runs what "
                "anyone sends it. Reach one elsewhere by a tunnel, ssh -L 8080:127.0.0.1:8080."
            )
        if self.profile.environment:
            raise ValidationError(f"{where}: a server of LeRobot's takes no environment.")
        names = [*self.profile.state, *(picture_key(each) for each in self.profile.cameras), TASK]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValidationError(f"{where}: state and cameras must have names of their own, not {', '.join(twice)}.")
        for module in ("grpc", "numpy"):
            _module(module)

    def connect(self, token: str, deadline: float) -> LeRobotAsyncConnection:
        connection = LeRobotAsyncConnection(self.profile)
        try:
            connection.instruct(self._instructions(), deadline)
        except BaseException:
            connection.close()
            raise
        return connection

    def observation(self, seen: Mapping[str, Any], task: str) -> dict[str, Any]:
        numpy, profile = _module("numpy"), self.profile
        pictures = {key: numpy.ascontiguousarray(seen[key]) for key in map(picture_key, profile.cameras)}
        return {**{key: float(seen[key]) for key in profile.state}, **pictures, TASK: task}

    def actions(self, answer: Any) -> list[Action]:
        chunk = self.profile.chunk
        if chunk is not None:
            compare("chunk", len(answer), chunk)
        if len({len(row) for row in answer}) != 1:
            raise PolicyServerError("the server answered actions of different lengths, or none")
        return actions_of(answer, self.profile.action)

    def act(self, observation: Mapping[str, Any]) -> list[Action]:
        try:
            return super().act(observation)
        except PolicyServerError:
            if isinstance(self._connection, LeRobotAsyncConnection):
                self._connection.lost = not self._interrupted.is_set()
            raise

    def close(self) -> None:
        """Leave the connection to the next task; a late answer went with its own call."""
        connection, self._connection = self._connection, None
        if isinstance(connection, LeRobotAsyncConnection) and connection.lost:
            connection.close()
        elif connection is not None:
            self.connections.give(self._key, connection)

    def _instructions(self) -> bytes:
        """Return what the server is to load, and how an observation becomes its features."""
        profile = self.profile
        names = list(profile.state)
        features: dict[str, Any] = {STATE: {"dtype": "float32", "shape": (len(names),), "names": names}}
        for camera in profile.cameras:
            size = (*(camera.size or (0, 0)), 3)
            axes = ["height", "width", "channels"]
            features[IMAGES + picture_key(camera)] = {"dtype": "image", "shape": size, "names": axes}
        state = {
            "policy_type": profile.policy_type,
            "pretrained_name_or_path": profile.checkpoint,
            "lerobot_features": features,
            "actions_per_chunk": profile.chunk or profile.horizon or CHUNK,
            "device": profile.device or "cpu",
            # The server renames after it has resized, so a renamed picture fails there; the profile's key is sent.
            "rename_map": {},
        }
        return pickled("RemotePolicyConfig", state)


def _field(number: int, value: bytes) -> bytes:
    """Return a field of bytes, as protobuf has it."""
    return bytes([number << 3 | 2]) + _varint(len(value)) + value


def _pieces(data: bytes) -> Iterator[bytes]:
    """Yield the messages of an observation: where it is of the whole, and its bytes."""
    for start in range(0, len(data), PIECE):
        place = _END if start + PIECE >= len(data) else _BEGIN if start == 0 else _MIDDLE
        yield bytes([1 << 3, place]) + _field(2, data[start : start + PIECE])


def _varint(value: int) -> bytes:
    made = bytearray()
    while value > 0x7F:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*made, value])


def _first_field(message: bytes) -> bytes:
    """Return the bytes of field 1, the only one; empty where there is none.

    Raises:
        PolicyServerError: another message.
    """
    if not message:
        return b""
    length, shift, at = 0, 0, 1
    while at < len(message) and shift < 35:
        length |= (message[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if not message[at - 1] & 0x80:
            break
    if message[0] != (1 << 3 | 2) or len(message) - at != length:
        raise PolicyServerError("the policy server sent a message that is none of LeRobot's")
    return message[at:]
