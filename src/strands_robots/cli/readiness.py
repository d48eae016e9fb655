"""Readiness of a served robot: its link, meeting port and state directory."""

from __future__ import annotations

import asyncio
import os
import pwd
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from strands_robots import settings
from strands_robots.state_files import state_dir
from strands_robots.utils import redacted

if TYPE_CHECKING:
    from cryptography import x509
    from device_connect_edge.drivers import DeviceDriver

    from strands_robots.device_connect.backends import LinkConfig


def certificate_problem(link: LinkConfig, now: datetime | None = None) -> str:
    """Return the problem of a link's certificates by its file, or empty."""
    moment = now or datetime.now(UTC)
    try:
        authorities, chain = _certificates(link.ca), _certificates(link.cert)
        for file, each in [*((link.ca, each) for each in authorities), *((link.cert, each) for each in chain)]:
            since, until = each.not_valid_before_utc, each.not_valid_after_utc
            if not since <= moment <= until:
                said = "has expired: it was valid until" if moment > until else "is not valid yet, but from"
                return f"{_named(file)} {said} {(until if moment > until else since):%Y-%m-%d %H:%M} UTC"
        return _misfit(link, chain, authorities) if chain else ""
    except OSError as exc:
        return f"{exc.filename} cannot be read: {exc.strerror}"
    except _UnusableError as exc:
        return str(exc)


def valid_until(link: LinkConfig) -> str:
    """Return the last valid day of a link's own certificate, else of its authority's."""
    return _certificates(link.cert or link.ca)[0].not_valid_after_utc.date().isoformat()


def own_host(link: LinkConfig) -> str:
    """Return the host in a link's own certificate that this machine reaches it by."""
    try:
        names = _hosts(_certificates(link.cert)[0]) if link.cert else []
    except (OSError, _UnusableError, IndexError):
        return ""
    return next((each for each in ("127.0.0.1", "localhost") if each in names), names[0] if names else "")


class _UnusableError(ValueError):
    """A file that holds something else."""


def _misfit(link: LinkConfig, chain: list[x509.Certificate], authorities: list[x509.Certificate]) -> str:
    """Return which of key, certificate and authority do not belong together."""
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415 - needs [device-connect]

    try:
        key = load_pem_private_key(_content(link.key), None)
    except (ValueError, TypeError) as exc:
        raise _UnusableError(f"{_named(link.key)} holds no PEM private key without a passphrase") from exc
    if chain[0].public_key() != key.public_key():
        return f"{_named(link.key)} is not the key of {_named(link.cert)}"
    if not any(_issued(chain[-1], each) for each in authorities):
        return f"{_named(link.cert)} was not issued by {_named(link.ca)}: peers that trust that authority refuse it"
    return ""


def _hosts(certificate: x509.Certificate) -> list[str]:
    from cryptography import x509  # noqa: PLC0415 - needs [device-connect]

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (x509.ExtensionNotFound, ValueError):
        return []
    stated = [*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress))]
    return [each for each in stated if not set("*:/") & set(each)]


def _issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - needs [device-connect]

    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return certificate == authority
    return True


def _certificates(given: str) -> list[x509.Certificate]:
    from cryptography import x509  # noqa: PLC0415 - needs [device-connect]

    try:
        return x509.load_pem_x509_certificates(_content(given)) if given else []
    except ValueError as exc:
        raise _UnusableError(f"{_named(given)} holds no PEM certificate") from exc


def _content(given: str) -> bytes:
    return given.encode() if _is_text(given) else Path(given).read_bytes()


def _named(given: str) -> str:
    return "the certificate in the credentials" if _is_text(given) else given


def _is_text(given: str) -> bool:
    return given.lstrip().startswith("-----BEGIN")


MEET_S = 1.0
"""Seconds in which the process that has the meeting port links with this one."""

DIAL_S = 3.0
"""Seconds in which an endpoint has to answer."""

LOOPBACK = "127.0.0.1"

_LISTEN = "0A"
"""State of a listening socket in ``/proc/net/tcp``."""


def shortcomings(driver: DeviceDriver, link: LinkConfig) -> list[str]:
    """Return one sentence for each reason why a served robot is not ready."""
    found = [driver_problem(driver), meeting_problem(link), link_certificate_problem(link), state_problem()]
    return [each for each in found if each]


def driver_problem(driver: DeviceDriver) -> str:
    """Return why the robot itself cannot be used, or empty."""
    status = driver.status
    if status.availability != "unavailable":
        return ""
    return f"The robot is unavailable: {(status.error_state or 'no reason is known').rstrip('.')}. It is tried again."


def link_certificate_problem(link: LinkConfig) -> str:
    """Return why the other side will refuse our certificates, or empty."""
    if not link.ca:
        return ""

    problem = certificate_problem(link)
    return (
        f"{problem[:1].upper()}{problem[1:]}. Others will not reach the robot; give matching files." if problem else ""
    )


def state_problem() -> str:
    """Return why the state directory cannot be written, or empty."""
    folder = state_dir()
    if not (why := unwritable(folder)):
        return ""
    return (
        f"The state directory {folder} cannot be written ({why}): a restart forgets a lockout, resume "
        "--local frees no robot, answers are not signed, and nothing is audited. Set STRANDS_STATE_DIR to a "
        "directory that this user can write."
    )


def unwritable(folder: Path) -> str:
    """Return why a folder, or the one that it would be made in, cannot be written."""
    try:
        with TemporaryFile(dir=next(each for each in (folder, *folder.parents) if each.exists())):
            return ""
    except OSError as exc:
        return exc.strerror or str(exc)


def meeting_problem(link: LinkConfig) -> str:
    """Return who else has the meeting port; empty for a robot process of this user."""
    if link.meet_port is None:
        return ""
    from strands_robots.device_connect.backends.zenoh import meets  # noqa: PLC0415 - loaded when it is used

    kind, until = meets(link), time.monotonic() + MEET_S
    while kind == "stranger" and time.monotonic() < until:
        time.sleep(0.05)
        kind = meets(link)
    uid, holder = port_holder(link.meet_port)
    if kind == "peer" and uid in (None, os.getuid()):
        return ""
    remedy = "End it, or choose another port with --port or STRANDS_DC_PORT."
    where = f"The meeting port {link.meet_port} is held by {holder}"
    if kind == "router":
        return f"{where}, a Zenoh router such as ROS 2's: robots of other processes may not be found. {remedy}"
    if kind == "stranger":
        return f"{where}, which is no robot process: robots of other processes are not found. {remedy}"
    return f"{where}: its robots and this one share a network, and either user can drive both. {remedy}"


def mesh_problems() -> list[str]:
    """Return one sentence for each reason why a robot on the mesh is not ready."""
    return [each for each in (mesh_port_problem(), state_problem()) if each]


def mesh_port_problem(*, answers: bool = True) -> str:
    """Return who else has the mesh's port; empty for a robot process of this user.

    Args:
        answers: a mesh answers there. A Zenoh router in Python is then not told from a robot process.
    """
    from strands_robots.mesh.transport.config import stated_endpoints  # noqa: PLC0415 - loaded when it is used

    if any(stated_endpoints()) or settings.raw("STRANDS_MESH_BACKEND").lower() not in ("", "zenoh", "bridge"):
        return ""
    number = settings.integer("STRANDS_MESH_PORT")
    uid, holder = port_holder(number)
    where = f"The mesh's port {number} is held by {holder}"
    remedy = "End it, or choose another port with --port or STRANDS_MESH_PORT."
    if not answers:
        held = f"{where}, and no mesh answers there: robots of other processes are not found. {remedy}"
        return "" if uid is None else held
    if uid not in (None, os.getuid()):
        return f"{where}: its robots and this one share a mesh, and either user can stop and see both. {remedy}"
    program = holder.partition("(")[2]
    if uid is not None and program and not program.startswith(("python", "strands-robots")):
        return f"{where}, which is no robot process: robots of other processes may not be found. {remedy}"
    return ""


def other_user(link: LinkConfig) -> str:
    """Return who else serves robots at the meeting port, or empty."""
    uid, holder = (None, "") if link.meet_port is None else port_holder(link.meet_port)
    if uid is None or uid == os.getuid():
        return ""
    return f"Robots at the meeting port {link.meet_port} are served by {holder} (uid {uid}), not by you."


def meeting_user(port: int | None) -> str:
    """Return the name of another user at a meeting port, or empty."""
    uid = None if port is None else port_holder(port)[0]
    return "" if uid is None or uid == os.getuid() else _user(uid)


def dial_problem(link: LinkConfig, endpoint: str) -> str:
    """Return why a client of ``link`` gets no connection to one endpoint, or empty.

    It connects as a robot does, with the same certificates and credentials.
    """
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when a network is used

    from strands_robots.device_connect.backends import open_client  # noqa: PLC0415 - as above
    from strands_robots.device_connect.backends.dial import reason_of  # noqa: PLC0415 - as above

    alone = replace(link, mode="client" if link.transport == "zenoh" else "auto", connect=(endpoint,), listen=())
    alone = replace(alone, meet_port=None, multicast=None, connect_timeout_s=DIAL_S)

    async def dial() -> None:
        client = await open_client(alone)
        await client.close()

    try:
        asyncio.run(dial())
    except MessagingError as exc:
        said = redacted(str(exc))
        return said.partition(f"{redacted(endpoint)}: ")[2] or said
    except OSError as exc:  # a certificate that cannot be used
        return reason_of(exc)
    return ""


def listen_problem(endpoint: str) -> str:
    """Return why nobody can listen on a TCP endpoint, or empty."""
    from strands_robots.device_connect.backends.config import host_of  # noqa: PLC0415 - as above
    from strands_robots.device_connect.backends.dial import reason_of  # noqa: PLC0415 - as above

    host, number = host_of(endpoint), endpoint.rpartition(":")[2]
    if not endpoint.startswith(("tcp/", "tls/")) or not number.isdecimal():
        return ""
    try:
        with socket.create_server((host, int(number)), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            return ""
    except OSError as exc:
        return reason_of(exc)


def port_holder(port: int) -> tuple[int | None, str]:
    """Return the user id and a description of what listens on a local TCP port.

    Linux alone tells it; the process of another user is told to root alone.
    """
    for uid, inode in _listeners(port):
        who = f"user {_user(uid)}"
        process = _process(inode) or _robot_processes(uid)
        return uid, f"{process} of {who}" if process else f"a process of {who}"
    return None, "another program"


def _listeners(port: int) -> Iterator[tuple[int, str]]:
    """Yield user id and inode of the sockets that listen on a loopback port."""
    ours = {"00000000", socket.inet_aton("127.0.0.1")[:: -1 if sys.byteorder == "little" else 1].hex().upper()}
    for table in ("tcp", "tcp6"):
        lines: list[str] = []
        with suppress(OSError):  # not Linux, or no IPv6
            lines = Path(f"/proc/net/{table}").read_text("ascii").splitlines()[1:]
        for line in lines:
            fields = line.split()
            address, _, number = fields[1].partition(":")
            if fields[3] == _LISTEN and int(number, 16) == port and (address in ours or set(address) == {"0"}):
                yield int(fields[7]), fields[9]


def _process(inode: str) -> str:
    """Return pid and program of the process that has a socket, or empty."""
    wanted = f"socket:[{inode}]"
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it ended, or is another user's
            if any(str(each.readlink()) == wanted for each in (folder / "fd").iterdir()):
                words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
                return f"pid {folder.name} ({' '.join(Path(each).name for each in words[:3] if each)})"
    return ""


def _robot_processes(uid: int) -> str:
    """Return pid and command of a user's robot processes, or empty."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it ended
            words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            if folder.stat().st_uid == uid and any("strands" in Path(each).name for each in words):
                found.append(f"pid {folder.name} ({' '.join(Path(each).name for each in words[:4] if each)})")
    return " or ".join(sorted(found)[:3])


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
