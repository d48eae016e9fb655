"""Built-in robots as subjects: simulated ones, and arms on emulated servos.

What a simulated robot writes is the setpoints of its actuators, which MuJoCo reads at its next step. They lie in the
memory of the process, so a fault of the bus meets the commands of a motion and not the freeze of a halt, which no cable
can keep from its place.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from strands_robots.envelope import is_error, text_of
from strands_robots.hardware.emulated import ServoBus, arm_servos, write_calibration
from strands_robots.robot import PLUG_INS, Robot
from strands_robots.testing.subject import BusRecorder, Subject
from strands_robots.utils import ValidationError

ARMS = ("so100_follower", "so101_follower")
"""LeRobot's types whose bus is emulated here."""

WORLD = ("so100", "so101", "rover")
STILL = 0.05
"""Greatest speed of a joint that stands, in radians or metres a second."""


def built_in(name: str, **options: Any) -> Subject:
    """Return the robot of a name as a subject.

    It has a recorder of its bus unless it is real hardware or of another package.

    Args:
        name: of ``Robot(name)``, or one of :data:`ARMS`, whose servos are emulated unless ``mode`` is ``real``.
        options: of the robot.

    Raises:
        ValidationError: a port for emulated servos.
    """
    if options.get("mode") == "real" or PLUG_INS.get(name) is not None:
        return Subject(lambda: Robot(name, **options), name=name)
    if name not in ARMS:
        return simulated(name, **options)
    if "port" in options:
        raise ValidationError(f"port is that of a real arm, and {name} is checked on emulated servos unless mode=real.")
    return emulated_arm(name, **options)


def simulated(name: str, **options: Any) -> Subject:
    """Return a simulated robot, with the writes to its actuators.

    Args:
        name: of ``Robot(name)``.
        options: of it.
    """
    return _in_simulation(lambda: Robot(name, **options), name)


def world() -> Subject:
    """Return a simulated world with an arm of each kind and a mobile base."""

    def make() -> Any:
        from strands_robots.simulation import Simulation  # noqa: PLC0415 - loads MuJoCo

        made = Simulation("world")
        for place, name in enumerate(WORLD):
            answer = made.add_robot(name, model=name, position=(0.0, float(place), 0.0))
            if is_error(answer):
                made.cleanup()
                raise ValidationError(text_of(answer))
        return made

    return _in_simulation(make, "world")


def _in_simulation(make: Callable[[], Any], name: str) -> Subject:
    recorder = BusRecorder()
    made: list[Any] = []

    def recorded() -> Any:
        robot = make()
        recorder.watch(robot.physics, "command")
        recorder.watch(robot.physics, "hold", "release", "reset", can_fail=False)
        made.append(robot)
        return robot

    def moving() -> bool:
        return any(abs(speed) > STILL for robot in made for speed in robot.physics.snapshot.qvel)

    return Subject(recorded, recorder, moving=moving, name=name)


class ServoRecorder(BusRecorder):
    """Writes that reach the emulated servos of an arm, and faults of their line.

    Each arm has servos of its own; faults are those of the first one that is not let go.
    """

    def __init__(self) -> None:
        super().__init__()
        self._buses: list[ServoBus] = []

    def arm(self, name: str, **options: Any) -> Any:
        """Make an arm of a LeRobot type, on servos that stand in the middle."""
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="conform-arm-")))
            calibration = write_calibration(folder / "calibration.json")
            bus = stack.enter_context(ServoBus(arm_servos(), link=folder / "arm", on_write=self._written))
            port: dict[str, Any] = {"port": bus.port, "calibration": str(calibration), "calibration_dir": str(folder)}
            robot = Robot(name, mode="real", **port, **options)
            self._buses.append(bus)
            stack.callback(self._buses.remove, bus)
            stack.callback(robot.cleanup)
            robot.cleanup = stack.pop_all().close
        return robot

    def moving(self) -> bool:
        """Return True while a shaft turns."""
        return self._buses[0].moving

    @contextmanager
    def raising(self, problem: Exception) -> Iterator[None]:
        """Pull the cable for the block: the driver gets input and output errors."""
        del problem
        bus = self._buses[0]
        bus.unplug()
        try:
            yield
        finally:
            bus.plug()

    @contextmanager
    def hanging(self) -> Iterator[None]:
        """Have no servo take or answer anything for the block."""
        bus = self._buses[0]
        bus.silent = True
        try:
            yield
        finally:
            bus.silent = False

    def _written(self, servo: int, address: int, data: bytes) -> None:
        self.wrote(f"{data.hex()} to address {address} of servo {servo}")


def emulated_arm(name: str, **options: Any) -> Subject:
    """Return LeRobot's own driver of an arm on emulated servos.

    Args:
        name: one of :data:`ARMS`.
        options: of ``Robot(name, mode="real")``; the port is that of the servos.
    """
    recorder = ServoRecorder()
    return Subject(lambda: recorder.arm(name, **options), recorder, moving=recorder.moving, name=name)
