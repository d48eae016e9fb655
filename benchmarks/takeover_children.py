"""A served robot with a policy, and a leader of it, for :mod:`benchmarks.takeover`.

``python -m benchmarks.takeover_children ORDER``: ``part`` (``robot`` or ``leader``), ``port``, and the ``file`` of its
recording.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
import random
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

from fixtures.child import serve
from fixtures.waiting import eventually

from benchmarks.dataset_writers import JOINTS, device
from strands_robots.policies.base import Action, Ranges, numbers
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.profiles import Profile

PEER = "arm-1"
BEAT_S = 0.02
LATENCY_S = 0.1
"""Time of one inference of the policy, which varies by a fifth of it either way."""

STEPS = 100
RANGES_PER_S = 2.0
"""Speed bound of the leader: whole ranges a second."""

POLICY = "bench_computed"


class Computed:
    """Policy that answers after its latency with a sweep from where the robot was."""

    uses_cameras = False
    took: ClassVar[list[tuple[float, float]]] = []
    """Beginning of each inference of this process, in monotonic seconds, and the seconds that it took."""

    draw: ClassVar[random.Random] = random.Random(7)

    def __init__(self) -> None:
        self._chunks = itertools.count()

    def reset(self, instruction: str, ranges: Ranges) -> None: ...

    def act(self, observation: Mapping[str, Any]) -> list[Action]:
        began = time.monotonic()
        time.sleep(LATENCY_S * self.draw.uniform(0.8, 1.2))
        self.took.append((began, time.monotonic() - began))
        present, way = numbers(observation), 0.2 if next(self._chunks) % 2 else -0.2
        return [{key: present[key] + way * step for key in JOINTS} for step in range(1, STEPS + 1)]

    def interrupt(self) -> None: ...

    def close(self) -> None: ...


def computed() -> ProfiledPolicy:
    """Return the policy with its profile; an entry point names this."""
    profile = Profile(
        POLICY, "remote", JOINTS, JOINTS, rate=1 / BEAT_S, max_speed=1.0, confirmed=frozenset({"units", "rate"})
    )
    return ProfiledPolicy(profile, Computed())


@dataclass(frozen=True, slots=True)
class Step:
    """One write of the control loop, in monotonic seconds."""

    at: float
    led_by: str
    jump: float
    """Farthest way from where the robot was to the target."""


class ServedRobot:
    """The robot: an arm that is at its targets at once, served and recorded."""

    def __init__(self, order: Mapping[str, Any]) -> None:
        from strands_robots.device_connect import init_device_connect_sync, loopback_config  # noqa: PLC0415 - heavy
        from strands_robots.hardware import HardwareRobot  # noqa: PLC0415 - likewise

        self._robot = HardwareRobot(device(), PEER)
        self._robot.connect()
        self._steps: list[Step] = []
        self._count = 0
        self._robot.subscribe(self._note)
        link = loopback_config(order["port"])
        self._runtime = init_device_connect_sync(self._robot, peer_id=PEER, link=link, allow_insecure=True)
        self._recording = ExitStack()
        if order.get("file"):
            from strands_robots.recording.file import Recorder, RobotRecording  # noqa: PLC0415 - as a robot's --record

            self._recorder = self._recording.enter_context(Recorder(Path(order["file"]), joints_of_events=False))
            self._recording.enter_context(RobotRecording(self._robot, self._recorder, PEER))

    def _note(self, event: Any) -> None:
        if event.kind == "step":
            self._count += 1
            apart = (abs(event.action[key] - event.observation.get(key, math.inf)) for key in event.action)
            self._steps.append(Step(time.monotonic(), event.led_by, max(apart, default=0.0)))

    def inferences(self) -> list[tuple[float, float]]:
        """Return the beginning and the seconds of each inference."""
        # This module runs under another name than the one that the entry point has.
        policies: Any = import_module("benchmarks.takeover_children")
        return list(policies.Computed.took)

    def ready(self) -> bool:
        """Return True when its e-stop link is up."""
        from strands_robots.safety.estop_listener import estop_listener  # noqa: PLC0415 - of this process

        return all(each.link.up for each in estop_listener().registrations)

    def steps(self) -> list[list[Any]]:
        """Return the steps since the last call: moment, whether the leader had taken over, and the jump."""
        steps, self._steps = self._steps, []
        return [[each.at, each.led_by, each.jump] for each in steps]

    def clear(self) -> None:
        """Free it."""
        from strands_robots.safety.plane import plane  # noqa: PLC0415 - of this process

        plane().clear_local("bench")
        eventually(lambda: not self._robot.teleoperating())

    def halt(self) -> None:
        """End what drives it."""
        self._robot.halt("bench")

    def held(self) -> bool:
        """Return True while a caller has its lease."""
        from strands_robots.serving.control_leases import leases_of  # noqa: PLC0415 - heavy

        return bool(leases_of(self._robot, hardware=True).facts()["held"])

    def writes(self) -> list[Any]:
        """Return the last write: its moment; and the moment of the last one that moved the arm."""
        writes, moved = list(self._robot.device.writes), 0.0
        for before, after in itertools.pairwise(writes[-100:]):
            if before.action != after.action:
                moved = after.at
        return [writes[-1].at if writes else 0.0, moved, len(writes)]

    def end(self) -> list[int]:
        """Leave the network; return how many steps were made, and how many are in the recording."""
        self._robot.halt("bench")
        self._recording.close()
        from strands_robots.device_connect import stop_device_connect  # noqa: PLC0415 - heavy

        stop_device_connect(self._runtime)
        self._robot.cleanup()
        if not hasattr(self, "_recorder"):
            return [self._count, 0]
        from strands_robots.recording.file import STEP, read_events  # noqa: PLC0415 - as above

        return [self._count, sum(event.event == STEP for event in read_events(self._recorder.path))]


class LeaderElsewhere:
    """The leader: a thread that sends fifty commands a second."""

    def __init__(self, order: Mapping[str, Any]) -> None:
        from strands_robots.fleet import connect  # noqa: PLC0415 - heavy

        self._fleet = connect(port=order["port"], mesh=False).__enter__()
        eventually(lambda: PEER in {each.id for each in self._fleet.robots()}, 30)
        self._lead: Any = None
        self._thread: threading.Thread | None = None
        self._over = threading.Event()
        self._away, self._sweeps, self._picture = 0.0, False, None
        self._failure = ""

    def lead(self, how: dict[str, Any]) -> None:
        """Begin."""
        self.finish()
        self._lead = self._fleet[PEER].lead("hand", **{"max_speed": RANGES_PER_S, **how})
        self._over, self._failure = threading.Event(), ""
        self._start = dict(self._lead.state.joints)
        self._away, self._sweeps = 0.0, False
        self._picture: Any = None
        self._thread = threading.Thread(target=self._run, args=(self._lead, self._over), daemon=True)
        self._thread.start()

    def _run(self, lead: Any, over: threading.Event) -> None:
        began_at, beat = time.monotonic(), 0
        while not over.wait(max(0.0, began_at + beat * BEAT_S - time.monotonic())):
            beat = max(beat + 1, int((time.monotonic() - began_at) / BEAT_S))
            swing = 5 * math.sin(3 * (time.monotonic() - began_at)) if self._sweeps else 0.0
            action = {key: value + self._away + swing for key, value in self._start.items()}
            age = None if self._picture is None else self._picture.age_s
            try:
                lead.send(action, picture_age_s=age)
            except Exception as exc:  # noqa: BLE001 - the parent is told
                self._failure = f"{type(exc).__name__}: {exc}"
                return

    def grip(self, away: float, sweeps: bool = False) -> float:
        """Take over, from so far away; return the moment."""
        self._away, self._sweeps, self._start = away, sweeps, dict(self._lead.state.joints)
        now = time.monotonic()
        self._lead.grip()
        return now

    def be_silent(self) -> None:
        """Send nothing any more."""
        self._over.set()

    def give_back(self) -> float:
        """Give back; return the moment."""
        now = time.monotonic()
        self._lead.give_back()
        return now

    def state(self) -> list[Any]:
        """Return who drives, why it holds, the failure, and the link's shortest way in ms."""
        state = self._lead.state
        return [state.state, state.why, self._failure, state.one_way_ms, state.dropped]

    def watch(self, seconds: float, fault: str) -> float:
        """Drive by pictures of thirty a second, which fail after so long; return when the last true one came."""
        from strands_robots.fleet.picture_age import PictureAge  # noqa: PLC0415 - heavy

        pictures = self._picture = PictureAge()
        eventually(lambda: self._lead.state.state == "led", every=0.005)
        began, number, true_at = time.monotonic(), 0, 0.0
        while self._lead.state.state != "held" and time.monotonic() < began + seconds + 5:
            now = time.monotonic()
            failed = now - began > seconds
            if not failed:
                number += 1
                true_at = now
                pictures.came(number.to_bytes(4), now)
            elif fault == "repeats":
                pictures.came((number - int(now * 30) % 5).to_bytes(4), now)
            elif fault == "lags":
                number += 1
                pictures.came(number.to_bytes(4), min(now - 1.0, true_at))
            time.sleep(max(0.0, now + 1 / 30 - time.monotonic()))
        return true_at

    def finish(self) -> None:
        """End the lead."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()
            self._lead.close()
            self._thread = None

    def end(self) -> None:
        """Leave."""
        self.finish()
        self._fleet.close()


def main() -> None:
    """Obey until standard input closes."""
    logging.disable(logging.ERROR)
    order = json.loads(sys.argv[1])
    part: Any = ServedRobot(order) if order["part"] == "robot" else LeaderElsewhere(order)
    names = [name for name in dir(part) if not name.startswith("_")]
    serve({name: getattr(part, name) for name in names})


if __name__ == "__main__":
    main()
