"""Robots in reach, on every network of this process."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Self

from strands_robots._mesh_switch import mesh_env_request
from strands_robots.errors import NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, FIND_S, MESH, STOP_S, FoundRobot, NetworkAdapter
from strands_robots.fleet.link_flags import LinkFlags
from strands_robots.fleet.remote_robot import RemoteRobot, combined, verdict_of_answer
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import DURATION_MAX_S, ValidationError, device_id, near, number, plain_text, shown

logger = logging.getLogger(__name__)

SOURCE = "strands-robots"
"""Caller's name where none is given."""


def connect(
    *,
    nats: Sequence[str] | str | None = None,
    connect: Sequence[str] | str | None = None,
    listen: Sequence[str] | str | None = None,
    multicast: bool = False,
    port: int | None = None,
    tenant: str | None = None,
    insecure: bool = False,
    tls_ca: str | Path | None = None,
    tls_cert: str | Path | None = None,
    tls_key: str | Path | None = None,
    credentials: str | Path | None = None,
    name: str = SOURCE,
    mesh: bool | None = None,
) -> Fleet:
    """Return the fleet in reach; use it as a context manager.

    Without arguments it is this machine, or the network that the environment names. The arguments down to
    ``credentials`` are the command line's network flags, for Device Connect; the mesh has its own settings::

        with connect(nats=["tls://broker:4222"], credentials="robot.creds.json") as fleet:
            print(fleet.robots())

    Args:
        nats: NATS servers, such as ``nats://host:4222``; one or a list, as the next two.
        connect: Zenoh endpoints to connect to, such as ``tls/host:7447``.
        listen: Zenoh endpoints to listen on.
        multicast: find peers on the local network by multicast.
        port: loopback port where local robots meet.
        tenant: Device Connect tenant: a fleet that sees no other one.
        insecure: accept a transport without authentication.
        tls_ca: authority that peers are checked against, a PEM file.
        tls_cert: this side's certificate.
        tls_key: this side's private key.
        credentials: Device Connect credentials file.
        name: the caller's name that robots see; letters, digits, ``_`` and ``-``.
        mesh: False leaves the mesh out; by default ``STRANDS_MESH`` decides.

    Raises:
        ValidationError: an argument outside its domain, or a network beyond this machine without authentication.
        MissingExtraError: Device Connect is asked for and not installed.
    """
    source, absent = device_id("name", name), dict[str, str]()
    files = {"tls_ca": tls_ca, "tls_cert": tls_cert, "tls_key": tls_key, "credentials": credentials}
    paths = {each: Path(file).expanduser() for each, file in files.items() if file is not None}
    flags = LinkFlags(_items(nats), _items(connect), _items(listen), multicast, port, tenant, insecure, **paths)
    networks: list[NetworkAdapter] = []
    if flags != LinkFlags() or find_spec("device_connect_edge") is not None:
        from strands_robots.fleet.device_connect import DeviceConnectNetwork  # noqa: PLC0415 - loaded when it is used

        networks.append(DeviceConnectNetwork(flags.link(), source))
    else:
        absent[DEVICE_CONNECT] = "the extra device-connect is not installed"
    if mesh is False or mesh_env_request() is False:
        absent[MESH] = "it is switched off"
    else:
        from strands_robots.fleet.mesh import MeshNetwork  # noqa: PLC0415 - as above

        networks.append(MeshNetwork(source))
    return Fleet(networks, absent)


class Fleet:
    """Robots of Device Connect and of the mesh, as a context manager.

    It is made by :func:`connect`::

        with connect() as fleet:
            for robot in fleet.robots():
                print(robot.id, robot.type, robot.network)
            arm = fleet["arm-1"]

    An id that both networks have is one robot where both answers are signed by one key: Device Connect is used. Of two
    robots the enrolled one is moved. Where no key decides, motions are refused; :meth:`RemoteRobot.halt` stops both.

    Args:
        networks: those to join, the one whose robots win an id first.
        absent: networks that are not joined, with the reason.

    Attributes:
        absent: networks that are not joined or do not answer, with the reason. A mesh without a hub is no error.
    """

    def __init__(self, networks: Sequence[NetworkAdapter], absent: Mapping[str, str] | None = None) -> None:
        self.absent: dict[str, str] = dict(absent or {})
        self._stated = tuple(networks)
        self._networks: tuple[NetworkAdapter, ...] = ()
        self._robots: dict[str, RemoteRobot] = {}

    def __enter__(self) -> Self:
        """Join the networks, side by side.

        Raises:
            UnreachableError: none of them can be reached.
        """
        problems = side_by_side(_opened, self._stated)
        unexpected = next((each for each in problems if isinstance(each, Exception)), None)
        if unexpected is not None:
            _close([each for each, why in zip(self._stated, problems, strict=True) if not why])
            raise unexpected
        self.absent |= {each.name: str(why) for each, why in zip(self._stated, problems, strict=True) if why}
        self._networks = tuple(each for each, why in zip(self._stated, problems, strict=True) if not why)
        if not self._networks:
            raise UnreachableError(self._absences)
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the networks."""
        networks, self._networks = self._networks, ()
        _close(networks)

    def robots(self, timeout: float = FIND_S) -> list[RemoteRobot]:
        """Look for robots and return them, sorted by id.

        A network that fails is named in :attr:`absent` until it answers again.

        Args:
            timeout: seconds at most; it ends early once no more robots come.

        Raises:
            UnreachableError: no network answers, or the fleet is not joined.
        """
        seconds, networks = number("timeout", timeout, low=0, high=DURATION_MAX_S), self._joined
        found: dict[str, tuple[FoundRobot, NetworkAdapter]] = {}
        listed = side_by_side(lambda each: _found(each, seconds), networks)
        for network, robots in zip(networks, listed, strict=True):
            self.absent.pop(network.name, None)
            if isinstance(robots, str):
                logger.warning("Robots on %s cannot be looked for: %s", network.name, robots)
                self.absent[network.name] = robots
        if all(isinstance(each, str) for each in listed):
            raise UnreachableError(self._absences)
        # The first network is the last to write, so its robots win an id.
        for network, robots in reversed(list(zip(networks, listed, strict=True))):
            if isinstance(robots, str):
                continue
            found |= {each.id: (each, network) for each in robots}
        for name, (each, network) in found.items():
            known = self._robots.get(name)
            if known is None:
                self._robots[name] = RemoteRobot(each, network, lambda: self._networks)
            else:
                known.rediscovered(each, network)
        return [self._robots[name] for name in sorted(found)]

    def where(self, *, kind: str | None = None, network: str | None = None) -> list[RemoteRobot]:
        """Look for robots of a kind or a network.

        Args:
            kind: a type or a model, as :attr:`RemoteRobot.type` and :attr:`RemoteRobot.model` have it.
            network: ``device_connect`` or ``mesh``.
        """
        return [
            each
            for each in self.robots()
            if (kind is None or kind in (each.type, each.model)) and (network is None or network == each.network)
        ]

    def stop(self) -> dict[str, StopVerdict]:
        """Halt every robot in reach, without a lockout; return the verdicts by id.

        A robot is stopped as soon as it is found. Never raises for a verdict.
        """
        answers = side_by_side(_all_stopped, self._joined)
        verdicts: dict[str, list[StopVerdict]] = {name: [] for name in self._robots}
        for each in answers:
            for name, answer in each.items():
                verdicts.setdefault(name, []).append(verdict_of_answer(answer, name))
        return {name: combined(name, verdicts[name], 0.0) for name in sorted(verdicts)}

    def __getitem__(self, robot: str) -> RemoteRobot:
        """Return the robot of this id, looked for where it is not known yet.

        Raises:
            NoSuchRobotError: no robot in reach has it; the message names similar ones and absent networks.
            UnreachableError: no network answers, or the fleet is not joined.
        """
        if not isinstance(robot, str):
            raise ValidationError(f"A robot's id is a text, not {shown(robot)}.")
        _ = self._joined
        if robot not in self._robots:
            self.robots()
        if robot not in self._robots:
            absent = "".join(f" Not joined: {name}, {why}." for name, why in self.absent.items())
            remedy = f"{near(robot, self._robots)}{absent}".strip()
            raise NoSuchRobotError(f"No robot {robot[:100]!r} is in reach", remedy=remedy)
        return self._robots[robot]

    def __contains__(self, robot: object) -> bool:
        return isinstance(robot, str) and (robot in self._robots or robot in {each.id for each in self.robots()})

    def __iter__(self) -> Iterator[RemoteRobot]:
        return iter(self.robots())

    @property
    def _joined(self) -> tuple[NetworkAdapter, ...]:
        if not self._networks:
            raise UnreachableError("not joined: use it as a context manager", remedy="with connect() as fleet: ...")
        return self._networks

    @property
    def _absences(self) -> str:
        return "; ".join(f"{name}: {why.rstrip('.')}" for name, why in self.absent.items())

    def __repr__(self) -> str:
        joined = ", ".join(each.name for each in self._networks) or "no network"
        return f"<Fleet on {joined}{''.join(f'; {name} is absent: {why}' for name, why in self.absent.items())}>"


def _items(stated: Sequence[str] | str | None) -> Sequence[str] | None:
    """Return one text as a list of one."""
    return [stated] if isinstance(stated, str) else stated


def _opened(network: NetworkAdapter) -> str | Exception:
    """Join a network; return the reason where that fails."""
    try:
        network.open()
    except UnreachableError as exc:
        return exc.why
    except Exception as exc:  # noqa: BLE001 - it is raised once the other networks are left
        return exc
    return ""


def _close(networks: Sequence[NetworkAdapter]) -> None:
    """Leave each network, also where another one fails."""
    for each in networks:
        try:
            each.close()
        except Exception as exc:  # noqa: BLE001 - the others are left all the same
            logger.warning("%s was not left in good order: %s", each.name, exc)


def _found(network: NetworkAdapter, timeout: float) -> list[FoundRobot] | str:
    """Return the robots of a network, or the reason where that fails."""
    try:
        return network.find(timeout)
    except RefusalError as exc:
        return exc.why
    except Exception as exc:  # noqa: BLE001 - the other networks have their robots
        return plain_text(f"{type(exc).__name__}: {exc}")


def _all_stopped(network: NetworkAdapter) -> Mapping[str, object]:
    try:
        return network.stop_all(STOP_S)
    except Exception as exc:  # noqa: BLE001 - a stop that fails is a verdict, whatever it raised
        return {f"the robots on {network.name}": exc}
