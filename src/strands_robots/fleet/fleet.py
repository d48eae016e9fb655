"""Robots in reach, on every network of this process."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from strands_robots._mesh_switch import mesh_env_request
from strands_robots.errors import NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, FIND_S, MESH, STOP_S, FoundRobot, NetworkAdapter
from strands_robots.fleet.callers import SOURCE
from strands_robots.fleet.enrollment import Enrolled, Enrolment, enroll, shown_key
from strands_robots.fleet.fleet_verdict import FleetVerdict, NetworkVerdict
from strands_robots.fleet.link_flags import LinkFlags
from strands_robots.fleet.lockout_report import LockoutReport, Resumed
from strands_robots.fleet.network_stop import not_left
from strands_robots.fleet.profiles import profile_for
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.safety.identity import fingerprint
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster import Roster
from strands_robots.safety.scope import Scope
from strands_robots.safety.stop_roster import READ_WITHIN_S, robots_known_at
from strands_robots.safety.unheard import unheard_now
from strands_robots.serving.stop_arguments import stop_reason, stop_scope
from strands_robots.tags import own_tags
from strands_robots.utils import DURATION_MAX_S, ValidationError, device_id, near, number, plain_text, shown

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
    flags = LinkFlags(**given) if profile is None else profile.flags(given)
    source = device_id("name", name if name is not None else (profile and profile.name) or SOURCE)
    absent: dict[str, str] = {}
    networks: list[NetworkAdapter] = []
    if profile is not None and not profile.reaches_devices(given):
        absent[DEVICE_CONNECT] = f"the connection profile {profile.label} has none of its networks"
    elif given or (profile is not None and profile.network) or find_spec("device_connect_edge") is not None:
        from strands_robots.fleet.device_connect.network import DeviceConnectNetwork  # noqa: PLC0415 - loaded when it is used

        networks.append(DeviceConnectNetwork(flags.link(), source))
    else:
        absent[DEVICE_CONNECT] = "the extra device-connect is not installed"
    stated = None if profile is None else profile.mesh
    if mesh is False or mesh_env_request() is False:
        absent[MESH] = "it is switched off"
    elif profile is not None and stated is None and mesh is None:
        # The mesh of the environment may be another fleet's.
        absent[MESH] = f"the connection profile {profile.label} has none"
    else:
        from strands_robots.fleet.mesh.network import MeshNetwork  # noqa: PLC0415 - as above

        networks.append(MeshNetwork(source, stated))
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
        joined = self._joined
        stops = side_by_side(_all_stopped, joined)
        return FleetVerdict([*stops, *self._not_reached(joined)], known=tuple(self._robots))

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
        joined, estop_id = self._joined, new_epoch()
        why, cut = stop_reason(reason)
        named = [only] if isinstance(only, str) else only
        scope, unread = stop_scope(named or None, cell)
        signer, unfit = _signer(signing_key)
        notes = tuple(filter(None, (cut, unread, unfit)))

        def remembers(meant: Scope) -> bool:
            # Of the robots that a stop means none need be on each network; only where none is on any all are stopped.
            if any(_bears(each, name) for each in joined for name in meant.only):
                return True
            return any(robots_known_at(lambda each=each: each.key)(meant) for each in joined)  # type: ignore[misc]

        def stopped(network: NetworkAdapter) -> NetworkVerdict:
            try:
                outcome = network.emergency_stop(
                    why, scope=scope, signing_key=signer, estop_id=estop_id, remembers=remembers
                )
            except Exception as exc:  # noqa: BLE001 - a network that fails must not hide the verdicts of the others
                return not_left(network, exc)
            strange = {name for name in scope.only if not _bears(network, name)}
            return NetworkVerdict(network.name, outcome, not_here=_not_remembered(network, strange))

        stops = [*side_by_side(stopped, joined), *self._not_reached(joined)]
        # After the stop: a handler of the log may block.
        for note in notes:
            logger.warning("Ignored: %s.", note)
        return FleetVerdict(stops, estop_id, tuple(self._robots) if scope.everything else tuple(scope.only), notes)

    def lockouts(self, timeout: float = FIND_S) -> dict[str, LockoutReport]:
        """Ask the robots in reach for their lockouts; return the reports by id.

        A robot on both networks is asked on the first one. A network that does not answer is named in :attr:`absent`.

        Args:
            timeout: seconds in which each robot has to answer.
        """
        seconds = number("timeout", timeout, above=0, high=60)
        return {each.name: each for _, reports in reversed(self._asked((), seconds)) for each in reports}

    def resume(self, signing_key: Any, robots: Sequence[str] | str = (), *, timeout: float = 5.0) -> dict[str, Resumed]:
        """Clear the lockouts of robots; return by id whether each is free.

        What each said comes with it. It starts no motion. A resume names the epochs that the robot holds now, so it
        never clears one of a later stop.

        Args:
            signing_key: the operator's Ed25519 private key.
            robots: ids; every robot in reach without any.
            timeout: seconds in which each robot has to answer.

        Raises:
            NoSuchRobotError: one of ``robots`` is on no network.
            KeyFileError: the enrolled keys cannot be used.
        """
        seconds = number("timeout", timeout, above=0, high=60)
        named = [robots] if isinstance(robots, str) else list(robots)
        wanted = [device_id("robots", each) for each in named]
        asked = self._asked(wanted, seconds)
        for each in wanted:
            if not any(each == report.name for _, reports in asked for report in reports):
                raise NoSuchRobotError(f"No robot {each!r} that can be resumed is in reach")
        for network, reports in asked:
            if unheard := unheard_now(network.key, {each.name for each in reports if not each.problem}):
                logger.warning("%s: %s", network.name, unheard)
        outcomes: dict[str, Resumed] = {}
        for network, reports in asked:
            # A robot that is served on both was freed by the first: it refuses a second resume.
            twice = [each.name for each in reports if each.name in outcomes]
            anew = {each.name: each for each in network.lockouts(twice, seconds)} if twice else {}
            now = [anew.get(each.name, each) for each in reports]
            for name, outcome in network.resume(now, signing_key, seconds).items():
                # Locked on one of two networks is locked.
                outcomes[name] = min(outcomes.get(name, outcome), outcome, key=lambda each: each[0])
        return outcomes

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
        asked = self._asked((), seconds, signed=True)
        keys: dict[str, dict[bytes, str]] = {}
        for network, reports in asked:
            for each in reports:
                if (key := shown_key(each)) is not None:
                    keys.setdefault(each.name, {}).setdefault(key, network.name)
        several = {name: shown for name, shown in keys.items() if len(shown) > 1}
        outcomes = {name: Enrolment(Enrolled.TWO_KEYS, said=_two_keys(shown)) for name, shown in several.items()}
        for network, reports in asked:
            alone = [each for each in reports if each.name not in several]
            for name, outcome in enroll(alone, network.key, replace=replace).items():
                # A key that one network shows is the robot's, though the other shows none.
                if name not in outcomes or outcomes[name].outcome is Enrolled.NO_KEY:
                    outcomes[name] = outcome
        return outcomes

    def _asked(
        self, robots: Sequence[str], seconds: float, *, signed: bool = False
    ) -> list[tuple[NetworkAdapter, list[LockoutReport]]]:
        """Return the reports of the lockable robots by network."""

        def asked(network: NetworkAdapter) -> list[LockoutReport] | str:
            try:
                there = network.lockable(seconds)
                wanted = [each for each in there if not robots or each in robots]
                return network.lockouts(wanted, seconds, signed=signed)
            except UnreachableError as exc:
                return exc.why

        joined, found = self._joined, list[tuple[NetworkAdapter, list[LockoutReport]]]()
        for network, reports in zip(joined, side_by_side(asked, joined), strict=True):
            self.absent.pop(network.name, None)
            if isinstance(reports, str):
                self.absent[network.name] = reports
            else:
                found.append((network, reports))
        if not found:
            raise UnreachableError(self._absences)
        return found

    def _not_reached(self, joined: Sequence[NetworkAdapter]) -> list[NetworkVerdict]:
        """Return networks that are not joined, and have robots that must answer."""
        absent = [each for each in self._stated if each not in joined]
        stops = [not_left(each, self.absent.get(each.name, "it is not joined")) for each in absent]
        # Of a network whose roster cannot be read it is not known whether a robot is there.
        return [each for each in stops if each.outcome is None or each.outcome.size]

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
    """Return one text as a list of one; None for an empty list."""
    return [stated] if isinstance(stated, str) else list(stated or ()) or None


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


def _all_stopped(network: NetworkAdapter) -> NetworkVerdict:
    try:
        answers, outcome = network.stop_all(STOP_S)
    except Exception as exc:  # noqa: BLE001 - a stop that fails is a verdict, whatever it raised
        return not_left(network, exc)
    return NetworkVerdict(network.name, outcome, answers)


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


def _bears(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a network has a robot now; False for a network that was left."""
    try:
        return network.bears(robot)
    except RefusalError:
        return False


def _not_remembered(network: NetworkAdapter, robots: Collection[str]) -> frozenset[str]:
    """Return those robots that this machine does not remember on a network.

    A roster that is not read in time, or cannot be, may have all of them.
    """
    rows: list[frozenset[str]] = []

    def read() -> None:
        try:
            rows.append(frozenset(row.name for row in Roster.of(network.key).rows))
        except Exception as exc:  # noqa: BLE001 - then each of them counts
            logger.warning("The roster of %s cannot be read: %s", network.name, exc)

    if robots:
        reading = threading.Thread(target=read, name="stop roster", daemon=True)
        reading.start()
        reading.join(READ_WITHIN_S)
    return frozenset(robots) - rows[0] if rows else frozenset()


def _two_keys(keys: Mapping[bytes, str]) -> str:
    shown_keys = ", ".join(f"{network} shows {fingerprint(key)}" for key, network in keys.items())
    return f"{shown_keys}; neither was enrolled"
