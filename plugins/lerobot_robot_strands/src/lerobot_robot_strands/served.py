"""A served robot as LeRobot's names and features tell it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from lerobot_robot_strands.ending import RobotEndedError, at_end, one_sentence
from strands_robots import connect
from strands_robots.errors import RefusalError, StrandsRobotsError
from strands_robots.fleet import Fleet, RemoteRobot
from strands_robots.policies.base import plain_numbers

OVERVIEW = "overview"
"""The camera of a simulated world that shows all of it."""


def feature(joint: str) -> str:
    """Return a joint as LeRobot names it: as it is where it ends as ``.pos`` or ``.vel`` do, else with ``.pos``."""
    return joint if "." in joint else f"{joint}.pos"


@contextmanager
def told(robot: str) -> Iterator[None]:
    """Turn a refusal into the sentence that ends the command."""
    try:
        yield
    except RefusalError as refused:
        raise RobotEndedError(f"strands: {refused}") from refused
    except StrandsRobotsError as exc:
        raise RobotEndedError(f"strands: {robot}: {exc}") from exc


class MadeElsewhere:
    """What LeRobot asks of a device and a served robot has where it is served."""

    @property
    def is_calibrated(self) -> bool:
        """True: it is calibrated where it is served."""
        return True

    def calibrate(self) -> None:
        """Do nothing: it is calibrated where it is served."""

    def configure(self) -> None:
        """Do nothing: it is configured where it is served."""


class ServedRobot:
    """A robot of the fleet, looked up when it is first asked for something.

    Args:
        peer_id: its id, or ``WORLD/ROBOT``.
        fleet: connection profile; empty for none.

    Raises:
        ValueError: there is no id.
    """

    def __init__(self, peer_id: str, fleet: str = "") -> None:
        if not peer_id:
            raise ValueError("peer_id must name a robot, such as arm-1; `strands-robots peers` lists those in reach.")
        self.id = peer_id
        self._profile = fleet
        self._fleet: Fleet | None = None

    @cached_property
    def remote(self) -> RemoteRobot:
        """The robot.

        Raises:
            RobotEndedError: it is not in reach, or is a world of several.
        """
        one_sentence()
        address, _, part = self.id.partition("/")
        with told(self.id):
            if self._fleet is None:
                self._fleet = connect(self._profile or None)
                self._fleet.__enter__()
                at_end.append(self.close)
            world = self._fleet[address]
            robots = world.robots
        if part in robots:
            return robots[part]
        if part or len(robots) > 1:
            known = ", ".join(f"{address}/{name}" for name in robots) or address
            raise RobotEndedError(f"strands: peer_id must be one of {known}, not {self.id}.")
        return next(iter(robots.values()), world)

    @cached_property
    def _features(self) -> dict[str, Any]:
        with told(self.id):
            return self.remote.features()

    @cached_property
    def joints(self) -> dict[str, str]:
        """Its joints that take targets: LeRobot's name, and the robot's own."""
        return self._named("action_features")

    @cached_property
    def measured(self) -> dict[str, str]:
        """Its joints that are measured: LeRobot's name, and the robot's own."""
        return self._named("observation_features")

    def _named(self, which: str) -> dict[str, str]:
        stated = self._features.get(which)
        if isinstance(stated, Mapping):
            # The other values are shapes of pictures.
            stated = [name for name, kind in stated.items() if kind == "float"]
        names = [str(name) for name in stated] if isinstance(stated, list) else []
        named = {feature(name): name for name in names}
        if not named:
            raise RobotEndedError(f"strands: {self.id} tells no {which}, so LeRobot cannot use it.")
        return named

    def reader(self) -> Callable[[], tuple[dict[str, float], float]]:
        """Return what reads its joints by their own names, and their age at its answer in seconds.

        It raises :class:`RefusalError` where the robot does not answer, and joins no network after :meth:`close`.
        """
        remote = self.remote

        def read() -> tuple[dict[str, float], float]:
            answer = remote.state()
            age = plain_numbers({"age": answer.get("joints_age_s")}).get("age", 0.0)
            return plain_numbers(answer.get("joints")), age

        return read

    def cameras(self, names: Sequence[str] | None) -> dict[str, str]:
        """Return the cameras that are used: LeRobot's name, and the robot's own.

        Args:
            names: as the robot has them; None for its own.

        Raises:
            RobotEndedError: it has no camera of a name.
        """
        if names is not None and not names:
            return {}
        listed: list[str] = []
        if "listCameras" in self.remote.verbs:
            with told(self.id):
                answer = self.remote.call("listCameras").get("cameras")
            listed = [str(each) for each in answer] if isinstance(answer, list) else []
        _, _, part = self.remote.id.partition("/")
        if names is None:
            own = [name for name in listed if (name.startswith(f"{part}/") if part else "/" in name)]
            names = own or ([OVERVIEW] if OVERVIEW in listed else listed)
        if unknown := [name for name in names if name not in listed]:
            known = ", ".join(listed) or "none"
            raise RobotEndedError(f"strands: camera_names must be of {known}, not {', '.join(unknown)}.")
        # LeRobot makes folders of its names.
        return {name.removeprefix(f"{part}/").replace("/", "."): name for name in names}

    def close(self) -> None:
        """Leave the network."""
        fleet, self._fleet = self._fleet, None
        self.__dict__.pop("remote", None)
        if fleet is not None:
            at_end.remove(self.close)
            fleet.__exit__(None, None, None)
