"""Emulator of the rail, in a process of its own or in a test::

    tarn-rail-emulator --port 7812

It moves by itself once it was told to, brakes for a stop, and answers it when it stands. A stop leaves it held until
a ``RELEASE``; an overload leaves a fault until a ``CLEAR``. A second session ends the first one, with what it has not
read.
"""

from __future__ import annotations

import argparse
import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Self

from tarn_rail.frames import NOTICE, BadFrameError, packed, unpacked

TICK_S = 0.005
LONGEST_STEP_S = 0.05
"""A motor does not make up for the time in which it hung."""

BRAKES_MM_S2 = 4000.0


class RailEmulator:
    """A rail on loopback. Close it, or use it as a context manager.

    Args:
        before_step: called before each step of the motor, by the recorder of a test. An OSError of it pulls the cable.
        port: 0 for any that is free.
        report: takes a line for each frame and each change of the motion.

    Attributes:
        lies: True for one that answers that it is held, and goes on.
        hangs: while it is set, nothing is read, answered or moved.
    """

    def __init__(
        self,
        before_step: Callable[[], object] = lambda: None,
        port: int = 0,
        report: Callable[[str], object] = lambda line: None,
    ) -> None:
        self._before_step, self._report = before_step, report
        self.lies, self.hangs = False, False
        self.state, self.position_mm, self.speed_mm_s = "IDLE", 0.0, 0.0
        self._target = 0.0
        self._braking: list[str] = []
        self._session: socket.socket | None = None
        self._buffer = b""
        self._listener = socket.create_server(("127.0.0.1", port))
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._closing, self._cut = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="tarn-rail-emulator", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def port(self) -> int:
        """The TCP port that it listens at."""
        return int(self._listener.getsockname()[1])

    @property
    def moving(self) -> bool:
        """True while its motor turns."""
        return self.speed_mm_s > 0

    def cut(self, *, out: bool = True) -> None:
        """Pull the cable, or put it back; the motion goes on."""
        self._cut = out

    def overload(self) -> None:
        """Block the carriage."""
        self.state, self.speed_mm_s = "FAULT", 0.0

    def close(self) -> None:
        """Switch it off."""
        self._closing.set()
        self.hangs = False
        self._thread.join(2.0)
        self._hang_up()
        self._selector.close()
        self._listener.close()

    def _run(self) -> None:
        last = time.monotonic()
        while not self._closing.is_set():
            ready = self._selector.select(TICK_S)
            while self.hangs:
                time.sleep(TICK_S)
            if self._cut:
                self._hang_up()
            for key, _ in ready:
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._receive()
            now = time.monotonic()
            try:
                self._step(min(now - last, LONGEST_STEP_S))
            except OSError:
                self._hang_up()
            last = now

    def _step(self, seconds: float) -> None:
        """Move the carriage by one step of its motor."""
        if self.state != "MOVING":
            return
        self._before_step()
        if self._braking:
            self.speed_mm_s = max(0.0, self.speed_mm_s - BRAKES_MM_S2 * seconds)
        way = min(self.speed_mm_s * seconds, abs(self._target - self.position_mm))
        self.position_mm += way if self._target > self.position_mm else -way
        if self._braking and not self.speed_mm_s:
            self._stands("HELD")
        elif self.position_mm == self._target:
            self._stands("IDLE")

    def _stands(self, state: str) -> None:
        braking, self._braking = self._braking, []
        self.state, self.speed_mm_s = "HELD" if braking else state, 0.0
        self._report(f"{self.state} at {self.position_mm:.1f}")
        for number in braking:
            self._answer(number, "OK", self.state, f"{self.position_mm:.1f}")

    def _accept(self) -> None:
        session, _ = self._listener.accept()
        if self._cut:
            session.close()
            return
        self._hang_up()
        session.settimeout(0.1)
        self._session, self._buffer = session, b""
        self._selector.register(session, selectors.EVENT_READ)
        self._answer(NOTICE, "READY", "TR-12")

    def _hang_up(self) -> None:
        session, self._session = self._session, None
        # Whoever asked for the stop is not there for its answer; the motor brakes all the same.
        self._braking = [""] if self._braking else []
        if session is not None:
            self._selector.unregister(session)
            session.close()

    def _receive(self) -> None:
        if self._session is None:
            return
        try:
            data = self._session.recv(4096)
        except OSError:
            data = b""
        if not data:
            self._hang_up()
            return
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            try:
                number, words = unpacked(line)
            except BadFrameError:
                self._answer(NOTICE, "CHECKSUM")
                continue
            if words[0] != "STATE":
                self._report(" ".join(words))
            self._obey(number, *words)

    def _obey(self, number: str, word: str, *values: str) -> None:
        if word == "STOP":
            self._stop(number)
        elif word == "STATE":
            self._answer(number, "OK", self._told, f"{self.position_mm:.1f}")
        elif word == "GO":
            self._go(number, *values)
        elif (word, self.state) in (("RELEASE", "HELD"), ("CLEAR", "FAULT")):
            self.state = "IDLE" if word == "RELEASE" else "HELD"
            self._answer(number, "OK", self.state)
        else:
            self._answer(number, "NO", self.state)

    @property
    def _told(self) -> str:
        return "HELD" if self.lies and self.state == "MOVING" else self.state

    def _go(self, number: str, *values: str) -> None:
        if self.state != "IDLE":
            self._answer(number, "NO", self.state)
            return
        try:
            self._target, self.speed_mm_s = (float(each) for each in values)
        except ValueError:
            self._answer(number, "NO", "NUMBER")
            return
        self.state = "MOVING"
        self._report(f"MOVING to {self._target:.1f}")
        self._answer(number, "OK", "MOVING")

    def _stop(self, number: str) -> None:
        if self.lies:
            self._answer(number, "OK", "HELD", f"{self.position_mm:.1f}")
        elif self.state == "MOVING":
            self._braking.append(number)
        else:
            self.state = self.state if self.state == "FAULT" else "HELD"
            self._answer(number, "OK", self.state, f"{self.position_mm:.1f}")

    def _answer(self, number: str, *words: str) -> None:
        if self._session is None or not number:
            return
        with suppress(OSError):  # whoever hung up reads no answer
            self._session.sendall(packed(number, *words))


def main() -> None:
    """Run it until Ctrl-C; print each frame and each change of the motion."""
    parser = argparse.ArgumentParser(description="Emulator of a Tarn TR-12")
    parser.add_argument("--port", type=int, default=7812)
    port = parser.parse_args().port

    def report(line: str) -> None:
        print(line, flush=True)

    with RailEmulator(port=port, report=report) as rail:
        report(f"listening {rail.port}")
        with suppress(KeyboardInterrupt):
            threading.Event().wait()


if __name__ == "__main__":
    main()
