"""A policy that a server computes: the part that all such clients share."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

from strands_robots.policies.base import Action, PolicyError, Ranges
from strands_robots.policies.decoding import MESSAGE_MAX
from strands_robots.policies.preload import PreloadedModels
from strands_robots.policies.profiles import Profile
from strands_robots.utils import ValidationError, choice, optional_module, shown

CHUNK_MAX = 10_000
"""Longest accepted chunk of actions."""

VALUES_MAX = 32_768
"""Most numbers of a chunk: 1,000 actions of 32 joints."""

PICTURE = (224, 224)
"""Size of pictures in the first inference where the profile states none; servers resize to it."""

_NUMBERS = frozenset({int, float})
_AXES_MAX = 3
"""Batch, step and dimension."""

SLICE_S = 0.01
"""Seconds between two looks at whether an answer is still wanted."""


class PolicyServerError(PolicyError):
    """The server refused, sent an unusable answer, or did not answer in time."""


class ServerConnection(Protocol):
    """One connection to a server; used by one policy at a time."""

    def infer(self, observation: Any, deadline: float, interrupted: threading.Event) -> Any:
        """Return the answer to an observation.

        Args:
            observation: as the server takes it.
            deadline: in monotonic seconds.
            interrupted: set when no answer is wanted any more.

        Raises:
            PolicyServerError: no answer in time, or none at all.
        """

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""


class ServedPolicy:
    """Policy that asks a server for every chunk; its profile has everything.

    Args:
        profile: with the server's ``url``.

    Raises:
        ValidationError: no profile, or one that this kind of server cannot serve.
        MissingExtraError: a package that the client needs is not installed.
    """

    provider: ClassVar[str]
    connections: ClassVar[PreloadedModels]
    """Connections on which an inference was made, by profile and server."""

    def __init__(self, profile: Profile | None = None) -> None:
        if profile is None or not profile.url:
            raise ValidationError(
                f"policy_provider {self.provider} needs a profile with a url: serve the robot with --policies."
            )
        self.uses_cameras = bool(profile.cameras)
        self.profile = profile
        self._key = (profile.name, profile.url)
        self._token = read_token(profile)
        self._connection: ServerConnection | None = None
        self._task = ""
        self._interrupted = threading.Event()

    def layout(self, layouts: tuple[str, ...]) -> str:
        """Return the profile's layout, the first one where it states none.

        Raises:
            ValidationError: a layout of another kind of server.
        """
        layout = self.profile.layout or layouts[0]
        return choice(f"profile {self.profile.name}: layout of provider {self.provider}", layout, layouts)

    def connect(self, token: str, deadline: float) -> ServerConnection:
        """Return a new connection, once what the server states agrees with the profile.

        Raises:
            PolicyServerError: no server answers, or its statements differ.
        """
        raise NotImplementedError

    def observation(self, seen: Mapping[str, Any], task: str) -> Any:
        """Return what is seen in the form that the server takes.

        Args:
            seen: numbers by the keys of ``state``, and RGB pictures by :attr:`CameraMap.short_key`.
            task: the instruction.
        """
        raise NotImplementedError

    def actions(self, answer: Any) -> list[Action]:
        """Return the chunk of an answer, by the profile's action keys.

        Raises:
            PolicyServerError: the answer has none that could be played.
        """
        raise NotImplementedError

    def begin(self, connection: ServerConnection) -> None:
        """Have the server forget the last task, where it keeps any of it."""

    def warm(self) -> str | None:
        """Connect, and let the server compile; see :class:`Warmable`."""
        return self.connections.warm(self._key, self._warmed, self.profile.name)

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._task = instruction
        self._connection = self.connections.take(self._key, self._warmed)
        self.begin(self._connection)

    def act(self, observation: Mapping[str, Any]) -> list[Action]:
        if self._connection is None:
            raise PolicyServerError("it was not reset")
        deadline = time.monotonic() + self.profile.deadline_s
        return self.actions(
            self._connection.infer(self.observation(observation, self._task), deadline, self._interrupted)
        )

    def interrupt(self) -> None:
        self._interrupted.set()

    def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is None:
            return
        if self._interrupted.is_set():
            # An answer may be on its way.
            connection.close()
        self.connections.give(self._key, connection)

    def _warmed(self) -> ServerConnection:
        """Return a connection on which one inference was made, and not played."""
        import numpy  # noqa: PLC0415 - loaded where a policy is used

        profile = self.profile
        deadline = time.monotonic() + profile.first_deadline_s
        connection = self.connect(self._token, deadline)
        try:
            blank: dict[str, Any] = dict.fromkeys(profile.state, 0.0)
            for camera in profile.cameras:
                blank[camera.short_key] = numpy.zeros((*(camera.size or PICTURE), 3), numpy.uint8)
            seen = self.observation(blank, profile.task or "stand still")
            self.actions(connection.infer(seen, deadline, threading.Event()))
        except BaseException:
            connection.close()
            raise
        return connection


def wait_for_answer(
    url: str, receive: Callable[[float], Any], deadline: float, interrupted: threading.Event, drop: Callable[[], None]
) -> Any:
    """Return what ``receive`` returns, as long as it is wanted.

    Args:
        url: of the server, for the error.
        receive: waits for the given seconds and raises TimeoutError when nothing came.
        deadline: in monotonic seconds.
        interrupted: set when no answer is wanted any more.
        drop: drops the connection, on which the late answer would be taken for the next one.

    Raises:
        PolicyServerError: the deadline has passed, or the task was stopped.
    """
    while True:
        left = deadline - time.monotonic()
        if interrupted.is_set() or left <= 0:
            drop()
            why = "was not waited for, because the task was stopped" if left > 0 else "did not answer in time"
            raise PolicyServerError(f"the policy server at {url} {why}")
        try:
            return receive(min(left, SLICE_S))
        except TimeoutError:
            continue


def actions_of(rows: Any, keys: tuple[str, ...]) -> list[Action]:
    """Return an array (horizon, dimension) as a chunk of actions.

    Raises:
        PolicyServerError: another shape, no step, more than CHUNK_MAX or VALUES_MAX, or something that is no finite
            number.
    """
    chunk = checked_chunk(rows, len(keys))
    return [dict(zip(keys, row, strict=True)) for row in chunk.astype(float).tolist()]


def checked_chunk(rows: Any, dimension: int) -> Any:
    """Return a chunk as an array of finite numbers; raises as :func:`actions_of`."""
    import numpy  # noqa: PLC0415 - loaded where a policy is used

    chunk = numbers_of(rows)
    if chunk.ndim != 2 or not 1 <= chunk.shape[0] <= CHUNK_MAX or chunk.shape[1] != dimension:
        raise PolicyServerError(
            f"the policy server answered actions of the shape {chunk.shape}, and the profile has {dimension} keys"
        )
    if chunk.size > VALUES_MAX:
        raise PolicyServerError(f"the policy server answered {chunk.size:,} numbers, and may answer {VALUES_MAX:,}")
    if chunk.dtype.kind not in "iuf" or not numpy.isfinite(chunk).all():
        raise PolicyServerError("the policy server answered actions that are no finite numbers")
    return chunk


def numbers_of(found: Any) -> Any:
    """Return an array as it is, and a number or lists of numbers as one.

    Texts are refused before numpy sees them: it makes room in every element for the longest one.

    Raises:
        PolicyServerError: anything else.
    """
    import numpy  # noqa: PLC0415 - loaded where a policy is used

    if isinstance(found, numpy.ndarray):
        return found
    if not _plain_numbers(found, _AXES_MAX):
        raise PolicyServerError(f"the policy server answered {shown(found)} in place of numbers")
    try:
        return numpy.array(found, float)
    except (ValueError, OverflowError) as exc:
        raise PolicyServerError(f"the policy server answered numbers that are no array: {exc!s:.200}") from exc


def _plain_numbers(found: Any, axes: int) -> bool:
    if not isinstance(found, list | tuple):
        return type(found) in _NUMBERS
    if axes and _NUMBERS.issuperset(map(type, found)):
        return True
    return axes > 1 and all(_plain_numbers(each, axes - 1) for each in found)


def compare(name: str, states: object, profile: object) -> None:
    """Refuse a server that states something else than the profile.

    Raises:
        PolicyServerError: naming both.
    """
    if states != profile:
        raise PolicyServerError(f"the server's {name} is {shown(states)}, and the profile has {shown(profile)}")


def read_token(profile: Profile) -> str:
    """Return the token in the profile's ``token_file``, or "" where it names none.

    Raises:
        ValidationError: the file cannot be read.
    """
    if not profile.token_file:
        return ""
    try:
        return Path(profile.token_file).expanduser().read_text(encoding="utf-8").strip()
    except OSError as exc:
        raise ValidationError(f"profile {profile.name}: token_file cannot be read: {exc.strerror}.") from None


_module = partial(optional_module, what="A policy server on a WebSocket", extra="remote")

_CLOSE_S = 0.5
_FRAMES_MAX = 2
"""Frames that wait unread; with more the server has to wait."""

_TOO_BIG = 1009


class ServerSocket:
    """Connection that is opened anew after it was lost; used by one thread at a time.

    Args:
        url: ``ws://`` or ``wss://``.
        headers: sent with the handshake.

    Raises:
        MissingExtraError: the [remote] extra is not installed.
    """

    def __init__(self, url: str, headers: Mapping[str, str] | None = None) -> None:
        self._url = url
        self._headers = dict(headers or {})
        self._client = _module("websockets.sync.client")
        self._errors = _module("websockets.exceptions")
        self._socket: Any = None
        self._open_socket = contextlib.ExitStack()
        # Where garbage arrives during the handshake, an assertion of websockets may fail.
        self.lost: tuple[type[Exception], ...] = (self._errors.WebSocketException, OSError, AssertionError)
        """Raised where the connection, or its opening, failed."""

    @property
    def is_open(self) -> bool:
        """Tell whether it was opened and not closed; a lost one counts as open."""
        return self._socket is not None

    def open(self, deadline: float) -> None:
        """Connect anew; ``deadline`` in monotonic seconds."""
        self.close()
        # Without extensions nothing is unpacked: what a frame says of its length holds.
        opening = self._client.connect(
            self._url,
            additional_headers=self._headers,
            open_timeout=_left(deadline),
            close_timeout=_CLOSE_S,
            ping_interval=None,
            compression=None,
            proxy=None,
            max_size=MESSAGE_MAX,
            max_queue=_FRAMES_MAX,
        )
        self._socket = self._open_socket.enter_context(opening)
        self._bound_writes(deadline)

    def send(self, frame: str | bytes, deadline: float) -> None:
        """Send a frame; a server that does not read it in time loses the connection."""
        if self._socket is None:
            raise ConnectionError("not connected")
        self._bound_writes(deadline)
        self._socket.send(frame)

    def receive(self, seconds: float) -> str | bytes:
        """Return the next frame.

        Raises:
            TimeoutError: none came in time.
            PolicyServerError: it is longer than MESSAGE_MAX.
        """
        try:
            frame: str | bytes = self._socket.recv(timeout=seconds)
        except self._errors.ConnectionClosed as exc:
            if exc.sent is not None and exc.sent.code == _TOO_BIG:
                raise PolicyServerError(
                    f"the policy server at {self._url} sent a frame of more than {MESSAGE_MAX:,} bytes"
                ) from exc
            raise
        return frame

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        self._socket = None
        with contextlib.suppress(*self.lost):  # a lost connection is closed already
            self._open_socket.close()

    def _bound_writes(self, deadline: float) -> None:
        # A blocked write, a pong's too, would keep the connection locked, and close() would wait for it.
        self._socket.socket.settimeout(_left(deadline))


def _left(deadline: float) -> float:
    return max(0.01, deadline - time.monotonic())
