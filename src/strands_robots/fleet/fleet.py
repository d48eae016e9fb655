"""Robots in reach, on every network of this process."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.adapter import FIND_S, SOURCE, LockoutReport, NetworkAdapter, Resumed, StopRequest
from strands_robots.fleet.lockouts import Enrolment, ask_lockouts, by_robot, enroll_all, resume_all, unheard_in
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.profiles import networks_of, profile_for
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.fleet.stops import estop_all, stop_all
from strands_robots.fleet.verdicts import FleetVerdict
from strands_robots.serving.stop_arguments import stop_reason, stop_scope
from strands_robots.tags import own_tags
from strands_robots.utils import DURATION_MAX_S, ValidationError, device_id, near, number, shown

logger = logging.getLogger(__name__)


def connect(
    fleet: str | Path | None = None,
    *,
    nats: Sequence[str] | str | None = None,
    connect: Sequence[str] | str | None = None,
    listen: Sequence[str] | str | None = None,
    multicast: bool | None = None,
    port: int | None = None,
    tenant: str | None = None,
    insecure: bool | None = None,
    tls_ca: str | Path | None = None,
    tls_cert: str | Path | None = None,
    tls_key: str | Path | None = None,
    credentials: str | Path | None = None,
    name: str | None = None,
    mesh: bool | None = None,
) -> Fleet:
    """Return the fleet in reach; use it as a context manager.

    Without arguments it is this machine, or the network that the environment names. The arguments down to
    ``credentials`` are the command line's network flags, for Device Connect; the mesh has its own settings::

        with connect(nats=["tls://broker:4222"], credentials="robot.creds.json") as fleet:
            print(fleet.robots())

    A connection profile has them in a file, for both networks::

        with connect("lab") as fleet:
            print(fleet.where(kind="so100", tags="mobile"))

    Args:
        fleet: a connection profile: its name, or the path of its file. Arguments that are given besides win. By default
            that of ``STRANDS_FLEET``, unless an argument down to ``port`` says where the network is.
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
        name: the caller's name that robots see; letters, digits, ``_`` and ``-``. By default the profile's, else
            ``strands-robots``.
        mesh: False leaves the mesh out; by default the profile and ``STRANDS_MESH`` decide.

    Raises:
        ValidationError: an argument outside its domain, a profile that cannot be used, or a network beyond this machine
            without authentication.
        MissingExtraError: Device Connect is asked for and not installed.
    """
    files = {"tls_ca": tls_ca, "tls_cert": tls_cert, "tls_key": tls_key, "credentials": credentials}
    arguments: dict[str, Any] = {
        "nats": _items(nats),
        "connect": _items(connect),
        "listen": _items(listen),
        "multicast": multicast,
        "port": port,
        "tenant": tenant,
        "insecure": insecure,
        **{each: None if file is None else Path(file).expanduser() for each, file in files.items()},
    }
    given = {each: value for each, value in arguments.items() if value is not None}
    profile = profile_for(fleet, given)
    source = device_id("name", name if name is not None else (profile and profile.name) or SOURCE)
    return Fleet(networks_of(profile, given, source, mesh=mesh, preload=True))


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
    """

    def __init__(self, networks: Networks | Sequence[NetworkAdapter]) -> None:
        self._networks = networks if isinstance(networks, Networks) else Networks(networks)
        self._robots: dict[str, RemoteRobot] = {}

    @property
    def absent(self) -> dict[str, str]:
        """Networks that are not joined or do not answer, with the reason.

        A mesh without a hub is no error.
        """
        return self._networks.absent

    def __enter__(self) -> Self:
        """Begin to join the networks, side by side; return once one of them is joined.

        Raises:
            UnreachableError: none of them can be reached.
        """
        self._networks.open()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the networks."""
        self._networks.close()

    def robots(self, timeout: float = FIND_S) -> list[RemoteRobot]:
        """Look for robots and return them, sorted by id.

        A network that fails is named in :attr:`absent` until it answers again.

        Args:
            timeout: seconds at most; it ends early once no more robots come.

        Raises:
            UnreachableError: no network answers, or the fleet is not joined.
        """
        found = self._networks.find(number("timeout", timeout, low=0, high=DURATION_MAX_S))
        for name, (each, network) in found.items():
            known = self._robots.get(name)
            if known is None:
                self._robots[name] = RemoteRobot(each, network, self._networks)
            else:
                known.rediscovered(each, network)
        return [self._robots[name] for name in sorted(found)]

    def where(
        self, *, kind: str | None = None, network: str | None = None, tags: Collection[str] | str | None = None
    ) -> list[RemoteRobot]:
        """Look for robots of a kind, of a network, or with tags.

        Args:
            kind: a type or a model, as :attr:`RemoteRobot.type` and :attr:`RemoteRobot.model` have it.
            network: ``device_connect`` or ``mesh``.
            tags: one or several, all of which a robot has to have.

        Raises:
            ValidationError: what no robot can have as a tag.
        """
        wanted = set(own_tags(() if tags is None else tags))
        return [
            each
            for each in self.robots()
            if (kind is None or kind in (each.type, each.model))
            and (network is None or network == each.network)
            and wanted <= set(each.tags)
        ]

    def stop(self) -> FleetVerdict:
        """Halt every robot in reach, without a lockout; return the verdicts by id.

        A robot is stopped as soon as it is found. The robots that this machine remembers of each network must answer.
        Never raises for a verdict.

        Raises:
            UnreachableError: the fleet is not joined.
        """
        self._networks.check_opened()
        return stop_all(self._networks, known=tuple(self._robots))

    def estop(
        self, reason: str = "", *, only: Sequence[str] | str = (), cell: str = "", signing_key: Any = None
    ) -> FleetVerdict:
        """Stop and lock every robot of every network; return the verdicts by id.

        A robot stays locked until the operator resumes it. The stop leaves on each network at once, under one id. With
        ``only`` or ``cell`` it is for those robots; where none of them is there, every robot is stopped. No argument
        refuses it: what cannot be read is left out, and every robot is stopped. Never raises for a verdict.

        Args:
            reason: sent to the robots, at most 200 characters.
            only: ids of the robots to stop; every robot without any.
            cell: stop the robots of this cell, and those without one.
            signing_key: an Ed25519 private key, for robots that act on signed stops only; then only enrolled robots can
                confirm it.

        Raises:
            UnreachableError: the fleet is not joined.
        """
        self._networks.check_opened()
        why, cut = stop_reason(reason)
        named = [only] if isinstance(only, str) else only
        scope, unread = stop_scope(named or None, cell)
        signer, unfit = _signer(signing_key)
        notes = tuple(filter(None, (cut, unread, unfit)))
        verdict = estop_all(self._networks, StopRequest(why, scope, signer), known=tuple(self._robots), ignored=notes)
        # After the stop: a handler of the log may block.
        for note in notes:
            logger.warning("Ignored: %s.", note)
        return verdict

    def lockouts(self, timeout: float = FIND_S) -> dict[str, LockoutReport]:
        """Ask the robots in reach for their lockouts; return the reports by id.

        A robot that is locked on one of two networks is locked. A network that does not answer is named in
        :attr:`absent`.

        Args:
            timeout: seconds in which each robot has to answer.
        """
        seconds = number("timeout", timeout, above=0, high=60)
        return by_robot(ask_lockouts(self._networks, seconds, look_s=seconds))

    def resume(self, signing_key: Any, robots: Sequence[str] | str = (), *, timeout: float = 5.0) -> dict[str, Resumed]:
        """Clear the lockouts of robots; return by id whether each is free.

        What each said comes with it. It starts no motion. A resume names the epochs that the robot holds now, so it
        never clears one of a later stop.

        Args:
            signing_key: the operator's Ed25519 private key.
            robots: ids; every robot in reach without any.
            timeout: seconds in which each robot has to answer.

        Raises:
            ValidationError: ``signing_key`` cannot sign, ``robots`` are no ids, or ``timeout`` is not above 0.
            NoSuchRobotError: one of ``robots`` is on no network.
            KeyFileError: the enrolled keys cannot be used.
        """
        seconds = number("timeout", timeout, above=0, high=60)
        if _signer(signing_key)[0] is None:
            raise ValidationError(f"signing_key must be an Ed25519 private key, not {type(signing_key).__name__}.")
        if not isinstance(robots, str | Collection):
            raise ValidationError(f"robots must be ids, not {shown(robots)}.")
        wanted = [device_id("robots", each) for each in ([robots] if isinstance(robots, str) else robots)]
        reports = ask_lockouts(self._networks, seconds, besides=wanted, look_s=seconds)
        if unheard := unheard_in(reports):
            logger.warning("%s", unheard)
        return resume_all(reports, signing_key, seconds, robots=wanted)

    def enroll(self, *, replace: bool = False, timeout: float = FIND_S) -> dict[str, Enrolment]:
        """Keep the public keys of the robots in reach.

        From then on only a signed answer counts. Compare each fingerprint with the one that ``strands-robots doctor``
        shows at the robot's own machine.

        Args:
            replace: accept another key than the enrolled one, or another network.
            timeout: seconds in which each robot has to answer.

        Raises:
            KeyFileError, OSError: the file of enrolled keys cannot be used; nothing was enrolled.
        """
        seconds = number("timeout", timeout, above=0, high=60)
        return enroll_all(ask_lockouts(self._networks, seconds, look_s=seconds, signed=True), replace=replace)

    def __getitem__(self, robot: str) -> RemoteRobot:
        """Return the robot of this id, looked for where it is not known yet.

        Raises:
            NoSuchRobotError: no robot in reach has it; the message names similar ones and absent networks.
            UnreachableError: no network answers, or the fleet is not joined.
        """
        if not isinstance(robot, str):
            raise ValidationError(f"A robot's id is a text, not {shown(robot)}.")
        self._networks.check_opened()
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

    def __repr__(self) -> str:
        joined = ", ".join(each.name for each in self._networks.joined) or "no network"
        return f"<Fleet on {joined}{''.join(f'; {name} is absent: {why}' for name, why in self.absent.items())}>"


def _items(stated: Sequence[str] | str | None) -> Sequence[str] | None:
    """Return one text as a list of one; None for an empty list."""
    return [stated] if isinstance(stated, str) else list(stated or ()) or None


def _signer(key: Any) -> tuple[Any, str]:
    """Return a key that can sign, None without one, and a note on one that cannot."""
    if key is None:
        return None, ""
    try:
        key.public_key()
        key.sign(b"")
    except Exception:  # noqa: BLE001 - whatever it raises, the stop leaves without it
        return None, "signing_key cannot sign, so the stop is not signed"
    return key, ""
