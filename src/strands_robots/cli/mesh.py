"""The native mesh at the command line: ``--mesh`` of ``serve``, ``peers``, ``stop``, ``estop``; and ``mesh keys``."""

from __future__ import annotations

import os
import shlex
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.output import Exit, Failure, Screen, label, plain, table
from strands_robots.envelope import Envelope, text_of

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

_WATCH_S = 0.2
_FOLDER = typer.Option("--folder", help="Where the authority and the certificates are kept.")
DEFAULT_FOLDER = Path("mesh-keys")


def register(app: typer.Typer) -> None:
    """Add ``mesh`` to the application."""
    mesh = typer.Typer(no_args_is_help=True, help="The native mesh: certificates and access rules.")
    keys = typer.Typer(no_args_is_help=True, help="Certificates for a mesh that leaves this machine.")
    command(keys, "init")(init)
    command(keys, "issue")(issue)
    command(keys, "acl")(acl)
    mesh.add_typer(keys, name="keys")
    app.add_typer(mesh, name="mesh")


def init(screen: Screen, folder: Annotated[Path, _FOLDER] = DEFAULT_FOLDER) -> None:
    """Make the fleet's own certificate authority."""
    from strands_robots.mesh import keys  # noqa: PLC0415 - loaded when it is used

    path = _made(lambda: keys.init(folder))
    screen.data({"status": "success", "ca": str(path)})
    screen.say(f"The authority is {path}. Keep {folder / keys.CA_KEY} to yourself; it makes the certificates.", "green")


def issue(
    screen: Screen,
    *,
    peer_id: Annotated[str, typer.Argument(help="The peer that the certificate is for.")],
    hosts: Annotated[list[str] | None, typer.Argument(help="Names or addresses by which others reach it.")] = None,
    folder: Annotated[Path, _FOLDER] = DEFAULT_FOLDER,
) -> None:
    """Make the certificate of one peer, and say how it is used."""
    from strands_robots.mesh import keys  # noqa: PLC0415 - loaded when it is used

    made = _made(lambda: keys.issue(folder.resolve(), peer_id, hosts or []))
    screen.data({"status": "success", **made.settings()})
    for name, value in made.settings().items():
        screen.copyable(f"export {name}={shlex.quote(str(value))}")


def acl(
    screen: Screen,
    *,
    robots: Annotated[list[str] | None, typer.Option("--robot", help="A peer that speaks as itself alone.")] = None,
    operators: Annotated[list[str] | None, typer.Option("--operator", help="A peer that also commands.")] = None,
    relays: Annotated[
        list[str] | None, typer.Option("--relay", help="A peer others are connected through; the operators.")
    ] = None,
    file: Annotated[Path, typer.Option("--file", help="Where the rules are written.")] = Path("mesh-acl.json5"),
) -> None:
    """Write access rules: by default nothing is allowed, a robot speaks as itself, an operator commands."""
    from strands_robots.mesh import keys  # noqa: PLC0415 - loaded when it is used

    rules = _made(lambda: keys.acl(robots or [], operators or [], relays))
    file.write_text(rules, encoding="utf-8")
    screen.data({"status": "success", "STRANDS_MESH_ACL_FILE": str(file.resolve())})
    screen.copyable(f"export STRANDS_MESH_ACL_FILE={shlex.quote(str(file.resolve()))}")


def serve_on_mesh(screen: Screen, body: Any, peer_id: str | None, mode: str) -> None:
    """Put ``body`` on the native mesh until Ctrl-C or SIGTERM, which stops the robot first."""
    from strands_robots.device_connect.shutdown import StopSignal  # noqa: PLC0415 - loads nothing of the framework

    with StopSignal() as asked, joined(body, peer_id, mode) as mesh:
        screen.data({"event": "serving", "peer_id": mesh.peer_id, "network": "mesh", "pid": os.getpid()})
        screen.say(f"{mesh.peer_id} is on the mesh. From another terminal: strands-robots peers --mesh", "green")
        screen.say("Ctrl-C stops the robot, then takes it off the mesh.")
        number = None
        while number is None:
            number = asked.wait(_WATCH_S)
        told = body.halt("the operator ended serve").envelope()
        screen.data({"event": "stopped", "status": told["status"], "stopped": told["stopped"]})
        screen.say(text_of(told))
    if told["stopped"] is not True:
        raise Failure("The robot was left moving: it did not confirm its stop.")
    if number == signal.SIGINT:
        raise KeyboardInterrupt


def peers_on_mesh(screen: Screen, timeout: float) -> None:
    """List the peers that announce themselves within ``timeout`` seconds."""
    with joined(None, own_id("console"), "tool") as mesh:
        time.sleep(timeout)
        rows = [row for row in mesh.peers if row["reachable"]]
    if not rows:
        raise Failure("Nobody is on the mesh of this machine.", Exit.SILENT, peers=[])
    screen.data({"status": "success", "peers": rows})
    cells = ((r["peer_id"], r["type"], r["hostname"], r.get("task_status", ""), f"{r['age']:.1f} s") for r in rows)
    screen.show(table("", ("peer", "type", "host", "status", "heard"), cells))


def stopped_on_mesh(screen: Screen, told: Envelope, end: str = "") -> None:
    """Show what became of a stop on the mesh: exits with 1 when one did not stop, with 3 when one or all are silent."""
    moving, silent = told.get("not_stopped", []), told.get("silent", [])

    def row(name: str, said: str) -> tuple[Any, ...]:
        if name in moving:
            return name, label("DID NOT STOP", "bold red"), said
        return name, label("NO ANSWER", "bold red") if name in silent else label("stopped", "green"), said

    screen.show(table("", ("robot", "answer", "what it said"), (row(*each) for each in told.get("robots", {}).items())))
    facts = {name: value for name, value in told.items() if name not in ("status", "content", "reason")}
    if told["status"] != "success":
        raise Failure(plain(text_of(told), 2000), Exit.REFUSED if moving else Exit.SILENT, **facts)
    screen.data({"status": "success", **facts})
    screen.say(f"{text_of(told)}{end}", "green")


def own_id(word: str) -> str:
    """An id for a command's stay on the mesh, which the certificate speaks for where there is one."""
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.wire_identity import IdentityError, visitor_id  # noqa: PLC0415 - as above

    try:
        return visitor_id(word)
    except (TransportError, IdentityError) as exc:
        raise Failure(str(exc), Exit.USAGE) from exc


@contextmanager
def joined(body: Any, peer_id: str | None, mode: str) -> Iterator[Mesh]:
    """A peer of the mesh while the block runs. Raises :class:`Failure` where there is no mesh to join."""
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - loaded when it is used

    try:
        mesh = init_mesh(body, peer_id, "sim" if mode == "sim" else mode)
    except ValueError as exc:
        raise Failure(str(exc), Exit.USAGE) from exc
    if mesh is None:
        raise Failure("STRANDS_MESH switches the mesh off.")
    try:
        if not mesh.alive:
            raise Failure("The mesh has no session; the log above says why.")
        yield mesh
    finally:
        mesh.close()


def _made(make: Any) -> Any:
    try:
        return make()
    except (ValueError, OSError) as exc:
        raise Failure(str(exc)) from exc
