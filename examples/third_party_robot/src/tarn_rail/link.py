"""Session with the rail over TCP: questions go out in order, and answers are told apart by their numbers."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress

from tarn_rail.frames import NOTICE, BadFrameError, packed, unpacked

DIAL_S = 0.3
DIAL_AGAIN_S = 0.1
SEND_S = 0.2
ANSWER_S = 0.4
"""Seconds in which the rail answers; a stop from full speed takes it 0.2 s."""


class RailError(Exception):
    """The rail could not be asked, or gave no answer that can be read."""


class RefusedError(RailError):
    """The rail said no; the text is its reason, such as ``HELD``."""


class RailLink:
    """Link to one rail, dialled again whenever it is lost. No call waits for the answer of another one.

    The rail goes on moving when it loses its session, and no caller watches it then. So each session begins with a
    ``STOP``.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._sending = threading.Lock()
        self._session: socket.socket | None = None
        self._up, self._closed = threading.Event(), threading.Event()
        self._answers: dict[str, Future[list[str]]] = {}
        self._number = 0
        self._keeper = threading.Thread(target=self._keep, name="tarn-rail", daemon=True)
        self._keeper.start()

    def ask(
        self, *words: str, within: float = ANSWER_S, only_if: Callable[[], bool] = lambda: True
    ) -> list[str] | None:
        """Ask, and return the words of the answer after its ``OK``.

        Args:
            words: of the question.
            within: seconds in which the link is up and the answer is here.
            only_if: looked at when no other frame can go out before this one; None is returned where it is false.

        Raises:
            RefusedError: the rail said no.
            RailError: there is no link, or no answer.
        """
        ends = time.monotonic() + within
        if not self._up.wait(within):
            raise RailError(f"there is no link to {self._address[0]}:{self._address[1]}")
        answer: Future[list[str]] = Future()
        with self._sending:
            if not only_if():
                return None
            number = self._send(answer, *words)
        try:
            said = answer.result(max(0.0, ends - time.monotonic()))
        except TimeoutError:
            raise RailError(f"{words[0]} was not answered within {within:g} s") from None
        finally:
            self._answers.pop(number, None)
        if said[0] != "OK":
            raise RefusedError(" ".join(said[1:]))
        return said[1:]

    def close(self) -> None:
        """Hang up, for good."""
        self._closed.set()
        with self._sending:
            self._hang_up()
        self._keeper.join(2 * DIAL_S)

    def _send(self, answer: Future[list[str]], *words: str) -> str:
        self._number = (self._number + 1) % 256
        number = f"{self._number:02X}"
        self._answers[number] = answer
        try:
            if self._session is None:
                raise RailError("the link was lost")
            self._session.sendall(packed(number, *words))
        except OSError as exc:
            self._answers.pop(number, None)
            self._hang_up()
            raise RailError(f"{words[0]} could not be sent: {exc}") from exc
        return number

    def _keep(self) -> None:
        while not self._closed.is_set():
            with suppress(OSError):
                self._serve(socket.create_connection(self._address, timeout=DIAL_S))
            self._closed.wait(DIAL_AGAIN_S)

    def _serve(self, session: socket.socket) -> None:
        with session:
            session.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            session.settimeout(SEND_S)
            with self._sending:
                if self._closed.is_set():
                    return
                self._session = session
                self._send(Future(), "STOP")
                self._up.set()
            try:
                self._read(session)
            finally:
                with self._sending:
                    self._hang_up()
                for waiting in list(self._answers.values()):
                    if not waiting.done():
                        waiting.set_exception(RailError("the link was lost"))

    def _hang_up(self) -> None:
        self._up.clear()
        session, self._session = self._session, None
        if session is not None:
            with suppress(OSError):  # it may be gone already
                session.shutdown(socket.SHUT_RDWR)

    def _read(self, session: socket.socket) -> None:
        buffer = b""
        while self._session is session:
            try:
                data = session.recv(4096)
            except TimeoutError:
                continue
            if not data:
                return
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                # A line that was garbled is a question that stays unanswered, which its caller is told.
                with suppress(BadFrameError):
                    self._take(*unpacked(line))

    def _take(self, number: str, words: list[str]) -> None:
        waiting = None if number == NOTICE else self._answers.get(number)
        if waiting is not None and not waiting.done():
            waiting.set_result(words)
