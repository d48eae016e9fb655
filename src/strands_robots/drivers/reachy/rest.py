"""Client of the daemon's REST interface, and stops that wait for no answer.

Each kind of failure has an error of its own.

Importable with the standard library alone; ``httpx`` is loaded by the first request. The daemon has no
authentication: every client that reaches its port controls the motors. What a gateway in front of it asks for is a
:class:`DaemonAccess`.

It may hang, so the answer to a stop is waited for on a thread of the round, never on that of the halt. A second stop is
sent beside the first one, which may wait for ever.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import ssl
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from strands_robots import settings
from strands_robots.bounded_json import OutOfBoundsError, json_object, parsed
from strands_robots.errors import StrandsRobotsError
from strands_robots.stop_log import stop_logger
from strands_robots.threads import ReadyThreads
from strands_robots.utils import (
    ValidationError,
    choice,
    dial_host_error,
    is_loopback_host,
    missing_extra,
    number,
    port,
    shown,
)

if TYPE_CHECKING:
    import httpx

logger = stop_logger(__name__)

CONNECT_S = 2.0
READ_S = 5.0
ANSWER_MAX_BYTES = 2**19
"""Longest answer that is read; a longer one is a fault of the daemon."""

DETAIL_MAX = 500
METHODS = ("GET", "POST", "PUT", "DELETE")


class DaemonError(StrandsRobotsError, RuntimeError):
    """A failed request. ``status`` is the HTTP status, 0 when there was no answer."""

    def __init__(self, message: str, status: int = 0) -> None:
        super().__init__(message)
        self.status = status


class DaemonUnreachableError(DaemonError):
    """No connection, no answer in time, or a connection lost."""


class DaemonRefusedError(DaemonError):
    """400, 401, 403, 405 or 422: the request itself is not accepted."""


class DaemonNotFoundError(DaemonError):
    """404: no such path, move or data set."""


class DaemonBusyError(DaemonError):
    """409: the daemon does something else, or cannot do this on this robot."""


class DaemonFaultError(DaemonError):
    """500 and the like: the request failed inside the daemon, which gives no reason."""


class BackendDownError(DaemonError):
    """503: the daemon drives no robot; it is stopped, failed or not started."""


_KINDS: dict[int, type[DaemonError]] = {
    400: DaemonRefusedError,
    401: DaemonRefusedError,
    403: DaemonRefusedError,
    404: DaemonNotFoundError,
    405: DaemonRefusedError,
    409: DaemonBusyError,
    422: DaemonRefusedError,
    503: BackendDownError,
}


def checked_host(value: object) -> str:
    """Return a bare hostname or IP literal; refuse anything else."""
    reason = dial_host_error(value)
    if reason is not None:
        raise ValidationError(reason)
    return str(value)


@lru_cache(maxsize=64)
def warn_once(warning: str) -> None:
    """Log a warning the first time in this process."""
    logger.warning("%s", warning)


@lru_cache(maxsize=2)
def tls_context(insecure: bool) -> ssl.SSLContext:
    """Return the context of every encrypted connection to a daemon.

    Made once: reading the system's certificates would cost a stop its first 50 ms.
    """
    context = ssl.create_default_context()
    if insecure:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context


@dataclass(frozen=True, slots=True)
class DaemonAccess:
    """Bearer token and encryption of the requests to one host."""

    host: str
    token: str = field(default="", repr=False)
    tls: bool = False
    insecure: bool = False

    @classmethod
    def stated(cls, host: str) -> DaemonAccess:
        """Return what the environment states; warn of what protects nothing.

        Raises:
            ValidationError: ``REACHY_DAEMON_TOKEN`` cannot be sent in a header.
        """
        token = settings.raw("REACHY_DAEMON_TOKEN")
        if not token.isascii() or not token.isprintable():
            raise ValidationError("REACHY_DAEMON_TOKEN must be printable ASCII; what it is set to is not.")
        tls = settings.boolean("REACHY_DAEMON_TLS", safe=True)
        insecure = tls and settings.boolean("REACHY_DAEMON_TLS_INSECURE")
        if token and not tls and not is_loopback_host(host.strip("[]")):
            warn_once(
                f"REACHY_DAEMON_TOKEN is sent to {host} unencrypted, where others can read it; set REACHY_DAEMON_TLS."
            )
        if insecure:
            warn_once(f"REACHY_DAEMON_TLS_INSECURE: whoever answers at {host} is taken for the daemon.")
        return cls(host, token, tls, insecure)

    @property
    def headers(self) -> dict[str, str]:
        """Headers that every request carries."""
        return {"Authorization": f"Bearer {self.token}"} if self.token else {}

    @property
    def context(self) -> ssl.SSLContext | None:
        """Context of a TLS connection; None for one in the clear."""
        return tls_context(self.insecure) if self.tls else None

    def url(self, scheme: str, api_port: int) -> str:
        """Return the URL of the daemon: ``http`` or ``ws``, with an s where encrypted.

        A certificate is made out to a name, so behind TLS a name is dialled as it is.
        """
        return f"{scheme}s://{self.host}:{api_port}" if self.tls else f"{scheme}://{url_host(self.host)}:{api_port}"


def url_host(host: str) -> str:
    """Return the host for a URL: an IP, localhost or ``*.local``.

    Since 1.12 the daemon answers to no other Host header, so any other name is resolved here.
    Raises :class:`DaemonUnreachableError` for a name without an address.
    """
    bare = host.strip("[]")
    try:
        literal = ipaddress.ip_address(bare)
    except ValueError:
        if bare == "localhost" or bare.rstrip(".").endswith(".local"):
            return bare
        try:
            addresses = socket.getaddrinfo(bare, None, type=socket.SOCK_STREAM)
        except OSError as exc:
            raise DaemonUnreachableError(f"{host} has no address: {exc}.") from exc
        literal = ipaddress.ip_address(addresses[0][4][0])
    return f"[{literal}]" if literal.version == 6 else str(literal)


class RestClient:
    """Requests to one daemon over kept-alive connections. Thread-safe.

    Args:
        host: bare hostname or IP literal.
        api_port: TCP port of the daemon.
        read_s: seconds to wait for an answer.
        longest: bytes of an answer beyond which it is not read.

    Raises:
        ValidationError: a host or port that cannot be dialled, or a token that cannot be sent.
    """

    def __init__(
        self, host: str, api_port: int = 8000, *, read_s: float = READ_S, longest: int = ANSWER_MAX_BYTES
    ) -> None:
        self.host = checked_host(host)
        self.port = port("api_port", api_port)
        self._access = DaemonAccess.stated(self.host)
        # The daemon itself speaks plain HTTP, which needs no certificates.
        self._context = self._access.context or ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._read_s, self._longest = read_s, longest
        self._lock = threading.Lock()
        self._pool: _Pool | None = None

    def get(self, path: str, within_s: float | None = None) -> Any:
        """Return the decoded body of a GET. Raises :class:`DaemonError`."""
        return self.request("GET", path, within_s=within_s)

    def post(self, path: str, body: dict[str, Any] | None = None, within_s: float | None = None) -> Any:
        """Return the decoded body of a POST. Raises :class:`DaemonError`."""
        return self.request("POST", path, body, within_s=within_s)

    def request(self, method: str, path: str, body: Any = None, *, within_s: float | None = None) -> Any:
        """Send one request and return its JSON; ``within_s`` replaces the time limits.

        Raises:
            DaemonError: by kind: unreachable, refused, not found, busy, backend down, fault.
        """
        httpx = _httpx()
        pool = self._enter()
        try:
            limit = pool.client.timeout if within_s is None else max(0.01, within_s)
            began = time.monotonic()
            with pool.client.stream(method, path, json=body, timeout=limit) as answer:
                text = bytearray()
                for part in answer.iter_raw():
                    text += part
                    if len(text) > self._longest:
                        self._retire(pool)
                        raise DaemonFaultError(f"{method} {path}: the answer is longer than {self._longest} bytes.")
                    if within_s is not None and time.monotonic() - began > within_s:
                        raise httpx.ReadTimeout("the answer did not end in time")
            if answer.status_code >= 500:
                # After a 500 the daemon resets the kept-alive connection under the next request.
                self._retire(pool)
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as exc:
            self._retire(pool)
            reason = str(exc) or type(exc).__name__
            raise DaemonUnreachableError(f"{self.host}:{self.port} did not answer {method} {path}: {reason}.") from exc
        finally:
            self._leave(pool)
        if not answer.is_success:
            kind = _KINDS.get(answer.status_code, DaemonFaultError)
            raise kind(f"{method} {path}: {_detail(answer.status_code, bytes(text))}", answer.status_code)
        try:
            return parsed(bytes(text), self._longest)
        except OutOfBoundsError as exc:
            raise DaemonFaultError(f"{method} {path}: the answer cannot be read: {exc}.", answer.status_code) from exc
        except ValueError as exc:
            raise DaemonFaultError(f"{method} {path}: the answer is not JSON.", answer.status_code) from exc

    def close(self) -> None:
        """Close the connections, each after its requests; a request opens new ones."""
        pool = self._pool
        if pool is not None:
            self._retire(pool)
            self._leave(pool, 0)

    def _enter(self) -> _Pool:
        with self._lock:
            if self._pool is not None:
                self._pool.users += 1
                return self._pool
        # Not under the lock: a name server that hangs would hold up the request behind this one.
        httpx = _httpx()
        fresh = _Pool(
            httpx.Client(
                base_url=self._access.url("http", self.port),
                timeout=httpx.Timeout(self._read_s, connect=CONNECT_S),
                # An answer is read up to its bound, which nothing that was compressed keeps.
                headers={"Accept-Encoding": "identity", **self._access.headers},
                verify=self._context,
                # A robot is on the local network: a proxy of the environment is not asked.
                trust_env=False,
            ),
            users=1,
        )
        with self._lock:
            if self._pool is None:
                self._pool = fresh
        return fresh

    def _retire(self, pool: _Pool) -> None:
        with self._lock:
            if self._pool is pool:
                self._pool = None

    def _leave(self, pool: _Pool, users: int = 1) -> None:
        # A retired pool is closed by its last user: a failed poll must not cut off a stop that is under way.
        with self._lock:
            pool.users -= users
            unused = pool.users == 0 and pool is not self._pool
        if unused:
            pool.client.close()


@dataclass(eq=False)
class _Pool:
    """Kept-alive connections and the number of requests that use them now."""

    client: httpx.Client
    users: int = 0


def api(  # noqa: PLR0917 - the documented order
    host: str, api_port: int, path: str, method: str = "GET", data: Any = None, timeout: float = READ_S
) -> Any:
    """Send one request over a connection of its own; never raises.

    Args:
        host: bare hostname or IP literal of the daemon.
        api_port: its TCP port, 8000 by default on a robot.
        path: with its query, such as ``/api/daemon/status``.
        method: GET, POST, PUT or DELETE.
        data: sent as JSON where it is not None.
        timeout: seconds to wait for an answer.

    Returns:
        The decoded JSON body, or ``{"error": sentence, "status_code": status}`` for a bad argument, an HTTP error, a
        lost connection (status 0) or a missing extra.
    """
    client = None
    try:
        client = RestClient(host, api_port, read_s=number("timeout", timeout, above=0, high=600))
        return client.request(choice("method", method, METHODS), _checked_path(path), data)
    except (ValidationError, DaemonError, ImportError, TypeError, ValueError) as exc:
        return {"error": str(exc), "status_code": exc.status if isinstance(exc, DaemonError) else 0}
    finally:
        if client is not None:
            client.close()


def _checked_path(path: object) -> str:
    if not isinstance(path, str) or not path.startswith("/") or not path.isascii() or not path.isprintable():
        raise ValidationError(f"path must be printable ASCII and start with '/', not {shown(path)}.")
    return path


def _httpx() -> Any:
    try:
        import httpx  # noqa: PLC0415 - optional, loaded by the first request
    except ImportError as exc:
        raise missing_extra("Reachy Mini", "reachy") from exc
    return httpx


def _detail(status: int, body: bytes) -> str:
    """Return the daemon's ``detail``, the first of a validation list, or the body."""
    text = body[:DETAIL_MAX].decode(errors="replace")
    detail: Any = json_object(body, ANSWER_MAX_BYTES).get("detail", text) if body[:1] == b"{" else text
    if isinstance(detail, list) and detail and isinstance(detail[0], dict):
        location = ".".join(str(part) for part in detail[0].get("loc", ()))
        detail = f"{location}: {detail[0].get('msg', '')}"
    return f"{status} {detail[:DETAIL_MAX] if isinstance(detail, str) else shown(detail)}"


ROUNDS_MAX = 8
"""Rounds that may wait for the daemon at once. A further stop waits for the first that returns."""

SAME_STOP_S = 0.02
"""Seconds in which a second order is taken for the same stop: the plane and the executor both order a halt."""

T = TypeVar("T")
Work = Callable[[T, float], object]
"""Sends the stop that its first argument describes; returns by its second, in monotonic s, unless the daemon hangs."""


@dataclass(eq=False)
class StopRound(Generic[T]):
    """One stop on its way to the daemon."""

    about: T
    within: float
    ordered: float = field(default_factory=time.monotonic)
    answer: Future[object] = field(default_factory=Future)

    @property
    def deadline(self) -> float:
        """Moment of ``time.monotonic`` by which the daemon must have answered."""
        return self.ordered + self.within

    def wait(self) -> object:
        """Return the answer.

        Raises:
            TimeoutError: none came by the deadline.
            Exception: whatever the work raised.
        """
        try:
            return self.answer.result(max(0.0, self.deadline - time.monotonic()))
        except TimeoutError as exc:
            raise TimeoutError(f"the daemon has not answered within {self.within:.2g} s") from exc

    def carry_out(self, work: Work[T]) -> None:
        """Do the work on this thread."""
        try:
            answer = work(self.about, self.deadline)
        except BaseException as exc:  # noqa: BLE001 - whatever a stop raises is graded by who waits for it
            self.answer.set_exception(exc)
        else:
            self.answer.set_result(answer)


def _senders() -> ReadyThreads[Callable[[], None]]:
    return ReadyThreads("stop-sender", 1, lambda carry_out: carry_out(), threading.Thread.start, _replace)


def _replace() -> None:
    """Start the successor of the thread that took a round, on that thread."""
    try:
        _OfProcess.senders.refill()
    except RuntimeError as exc:
        logger.critical("No thread can be started for the next stop, which waits for this one: %s.", exc)


class _OfProcess:
    senders = _senders()

    @classmethod
    def renew(cls) -> None:
        """Start anew in a forked child, which has none of its parent's threads."""
        cls.senders = _senders()


os.register_at_fork(after_in_child=_OfProcess.renew)


def prepare_stops() -> None:
    """Have a thread ready for the next stop. Raises RuntimeError where there is none."""
    if not _OfProcess.senders.wanted:
        _OfProcess.senders.prepare()


class StopRounds(Generic[T]):
    """Rounds of one kind for one robot; thread-safe.

    Args:
        work: carries a round out, on a thread of its own.
    """

    def __init__(self, work: Work[T]) -> None:
        self._work = work
        self._changing = threading.Lock()
        self._running = 0
        self._next: StopRound[T] | None = None
        self._unclaimed: StopRound[T] | None = None

    def order(self, about: T, within: float) -> None:
        """Send a stop at once, for the next :meth:`claim`. Does not wait for the daemon."""
        self._ordered(about, within)

    def claim(self, about: T, within: float) -> StopRound[T]:
        """Return the last round, if it goes on and is about the same, else a new one."""
        with self._changing:
            latest, self._unclaimed = self._unclaimed, None
        if latest is not None and not latest.answer.done() and (about is None or latest.about is about):
            return latest
        latest = self._ordered(about, within)
        with self._changing:
            self._unclaimed = None
        return latest

    def _ordered(self, about: T, within: float) -> StopRound[T]:
        fresh = StopRound(about, within)
        with self._changing:
            latest = self._unclaimed
            same = latest is not None and not latest.answer.done() and about in (None, latest.about)
            if latest is not None and same and fresh.ordered - latest.ordered < SAME_STOP_S:
                return latest
            if self._running >= ROUNDS_MAX:
                # It begins after all that share it, so its time is counted from the last of them.
                self._unclaimed = self._next = self._next or fresh
                self._next.about, self._next.ordered = about, fresh.ordered
                return self._next
            self._unclaimed = fresh
            self._running += 1
        try:
            prepare_stops()
            _OfProcess.senders.items.put(partial(self._run, fresh))
        except RuntimeError as exc:
            logger.critical("No thread can be started to stop the daemon's moves; this one does it: %s.", exc)
            self._run(fresh)
        return fresh

    def _run(self, stop: StopRound[T] | None) -> None:
        while stop is not None:
            stop.carry_out(self._work)
            with self._changing:
                stop, self._next = self._next, None
                self._running -= stop is None
