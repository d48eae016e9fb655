"""``keys``, ``mesh keys``: keys that are made. ``enroll``: robots' keys, learned."""

from __future__ import annotations

import getpass
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from strands_robots.cli.app import Timeout
from strands_robots.cli.network import Network, say_missing
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.lockouts import (
    FORGET,
    Enrolled,
    Enrolment,
    ask_lockouts,
    by_robot,
    change_enrolment,
    enroll_all,
    served_here,
)
from strands_robots.safety import ed25519
from strands_robots.safety.ed25519 import keygen, load_signing_key
from strands_robots.safety.identity import (
    DEFAULT_TENANT,
    OFF,
    RETIRED,
    EnrolledKeys,
    EnrolledRobot,
    KeyFileError,
    console_key,
    enrolled_consoles,
    fingerprint,
)
from strands_robots.safety.lockout import utc
from strands_robots.safety.roster import described
from strands_robots.state_files import state_dir
from strands_robots.utils import identifier, number, operator, shown, text

T = TypeVar("T")

PassphraseFile = Annotated[
    Path | None, typer.Option("--passphrase-file", help="Its passphrase, on the first line; else it is asked for.")
]
DEFAULT_FOLDER = Path("mesh-keys")
KeyFile = Annotated[Path, typer.Argument(help="Where the key is written, encrypted; never over a file.")]
Folder = Annotated[Path, typer.Option("--folder", help="Folder of the authority and the certificates.")]


def resume(screen: Screen, *, file: KeyFile, passphrase_file: PassphraseFile = None) -> None:
    """Make an operator's resume key, and print the setting that robots need for it."""
    _make_key(screen, file, passphrase_file, "STRANDS_MESH_RESUME_PUBLIC_KEY")


def estop(screen: Screen, *, file: KeyFile, passphrase_file: PassphraseFile = None) -> None:
    """Make a safety controller's signing key, and print the setting that robots need for it."""
    _make_key(screen, file, passphrase_file, "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")


def console(screen: Screen) -> None:
    """Print the public key of this user's consoles, for robots on other machines."""
    public = _refusable(lambda: console_key().load_or_make()).public_text
    screen.data({"status": "success", "STRANDS_MESH_CONSOLE_PUBLIC_KEYS": public})
    screen.say(
        "Robots of this user on this machine know it. On each robot's machine `enroll --console` takes it, or set:",
        "green",
    )
    screen.copyable(f"export STRANDS_MESH_CONSOLE_PUBLIC_KEYS={public}")


def mcp(
    screen: Screen,
    *,
    name: Annotated[str, typer.Argument(help="The caller that robots see.")],
    read_only: Annotated[bool, typer.Option("--read-only", help="It reads and stops, and moves nothing.")] = False,
    approves: Annotated[
        bool, typer.Option("--approves", help="Its user's yes approves a motion of real hardware.")
    ] = False,
    revoke: Annotated[bool, typer.Option("--revoke", help="Remove the token of this name.")] = False,
) -> None:
    """Make a bearer token for a client of `mcp --http`, or revoke it."""
    from strands_robots.http_access import Token, TokenFile  # noqa: PLC0415 - loaded when it is used

    tokens = TokenFile()
    if revoke:
        if not _refusable(lambda: tokens.revoke(name)):
            raise CliError(f"{name} has no token.", Exit.USAGE)
        screen.data({"status": "success", "name": name, "revoked": True})
        screen.say(f"{name} has no token any more.", "green")
        return
    text = _refusable(lambda: tokens.make(Token(name, read_only, approves)))
    screen.data({"status": "success", "name": name, "token": text})
    screen.say(f"The token of {name}; it is shown this once:", "green")
    screen.copyable(text)


def init(screen: Screen, folder: Folder = DEFAULT_FOLDER) -> None:
    """Make the fleet's own certificate authority."""
    from strands_robots.certificates import CA_KEY  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.transport import config  # noqa: PLC0415 - loaded when it is used

    path = _refusable(lambda: config.make_authority(folder))
    screen.data({"status": "success", "ca": str(path)})
    screen.say(f"The authority is {path}. Keep {folder / CA_KEY} to yourself; it makes the certificates.", "green")


def issue(
    screen: Screen,
    *,
    peer_id: Annotated[str, typer.Argument(help="The peer that the certificate is for.")],
    hosts: Annotated[list[str] | None, typer.Argument(help="Names or addresses by which others reach it.")] = None,
    folder: Folder = DEFAULT_FOLDER,
) -> None:
    """Make the certificate of one peer, and print its settings."""
    from strands_robots.mesh.transport import config  # noqa: PLC0415 - loaded when it is used

    issued = _refusable(lambda: config.issue_certificate(folder.resolve(), peer_id, hosts or [])).settings()
    screen.data({"status": "success", **issued})
    for name, value in issued.items():
        screen.copyable(f"export {name}={shlex.quote(str(value))}")


def acl(
    screen: Screen,
    *,
    robots: Annotated[list[str] | None, typer.Option("--robot", help="A peer that sends as itself only.")] = None,
    operators: Annotated[list[str] | None, typer.Option("--operator", help="A peer that also commands.")] = None,
    relays: Annotated[
        list[str] | None, typer.Option("--relay", help="A peer others are connected through; the operators.")
    ] = None,
    file: Annotated[Path, typer.Option("--file", help="Where the rules are written.")] = Path("mesh-acl.json5"),
) -> None:
    """Write access rules: deny by default, a robot sends as itself, an operator also commands."""
    from strands_robots.mesh.transport import config  # noqa: PLC0415 - loaded when it is used

    rules = _refusable(lambda: config.named_rules(robots or [], operators or [], relays))
    file.write_text(rules, encoding="utf-8")
    screen.data({"status": "success", "STRANDS_MESH_ACL_FILE": str(file.resolve())})
    screen.copyable(f"export STRANDS_MESH_ACL_FILE={shlex.quote(str(file.resolve()))}")


def operator_key() -> Path:
    """Return the usual place of the operator's key."""
    return state_dir() / "operator.pem"


def signing_key(path: Path, passphrase_file: Path | None = None) -> Any:
    """Return the private key in ``path``.

    Raises:
        CliError: it cannot be read, or the passphrase does not open it.
    """
    if not path.is_file():
        raise CliError(f"--key {path} is no file.", Exit.USAGE)
    try:
        return load_signing_key(path, _passphrase(f"Passphrase of {path}: ", passphrase_file))
    except (ValueError, OSError) as exc:
        raise CliError(str(exc)) from exc


def _passphrase(prompt: str, file: Path | None = None) -> str:
    """Read the passphrase from a file, or ask for it without showing it.

    Raises:
        CliError: the file cannot be read, or there is neither a file nor a terminal.
    """
    if file is not None:
        try:
            lines = file.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as exc:
            raise CliError(f"--passphrase-file cannot be read: {exc}", Exit.USAGE) from exc
        return lines[0] if lines else ""
    if not sys.stdin.isatty():
        raise CliError("A passphrase is asked for on a terminal only; give --passphrase-file here.", Exit.USAGE)
    return getpass.getpass(prompt)


def _make_key(screen: Screen, file: Path, passphrase_file: Path | None, setting: str) -> None:
    passphrase = _passphrase("Passphrase: ", passphrase_file)
    if passphrase_file is None and _passphrase("Again: ") != passphrase:
        raise CliError("The two passphrases differ.", Exit.USAGE)
    try:
        if file == operator_key():
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        public = keygen(file, passphrase)
    except OSError as exc:
        raise CliError(f"{file} was not written: {exc}") from exc
    screen.data({"status": "success", "file": str(file), setting: public})
    screen.say(f"The key is {file}. Keep it and its passphrase to yourself; on each robot's machine set:", "green")
    screen.copyable(f"export {setting}={public}")


def _refusable(make: Callable[[], T]) -> T:
    try:
        return make()
    except (ValueError, OSError) as exc:
        raise CliError(str(exc)) from exc


REASON_MAX = 200

Retire = Annotated[str, typer.Option("--retire", metavar="NAME", help="It is gone for good: no stop waits for it.")]
Off = Annotated[str, typer.Option("--off", metavar="NAME", help="It is switched off: no stop waits for it.")]
Forget = Annotated[str, typer.Option("--forget", metavar="NAME", help="Undo its enrolment.")]
Reason = Annotated[str, typer.Option("--reason", help="With --retire and --off: printed at every stop.")]
Listed = Annotated[bool, typer.Option("--list", help="Show the enrolled robots with network and exemption.")]

UNDONE = "It must answer again as soon as it is heard with its enrolled key."


def _change_of(*, retire: str, off: str, forget: str, reason: str) -> tuple[str, str] | None:
    """Return the change that the options ask for, and the robot's name; or None.

    Raises:
        CliError: two of them, or a reason for none.
        ValidationError: a name or a reason out of its domain.
    """
    stated = [
        (action, text(flag, name, longest=256))
        for action, flag, name in ((RETIRED, "--retire", retire), (OFF, "--off", off), (FORGET, "--forget", forget))
        if name
    ]
    if len(stated) > 1:
        raise CliError("--retire, --off and --forget are one at a time.", Exit.USAGE)
    text("--reason", reason, longest=REASON_MAX, empty=True)
    if reason and (not stated or stated[0][0] == FORGET):
        raise CliError("--reason goes with --retire or --off.", Exit.USAGE)
    return stated[0] if stated else None


def _apply(screen: Screen, action: str, robot: str, reason: str, tenant: str) -> None:
    """Carry out a change of an enrolled robot, and record it in the audit.

    Raises:
        CliError: it is not enrolled, or the file cannot be used.
    """
    try:
        name = change_enrolment(robot, action, reason, tenant=tenant)
    except NoSuchRobotError as exc:
        raise CliError(plain(str(exc), 2000), robots={}) from exc
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was changed: {exc}") from exc
    screen.data({"status": "success", "robot": name, "action": action, "by": operator(), "reason": reason})
    if action == FORGET:
        screen.say(f"{name} is not enrolled any more: its answers are not checked, and no stop waits for it by name.")
    else:
        screen.say(f"{name} is {action}: every stop prints that, and waits for it no more. {UNDONE}")
        if served_here(name):
            screen.say(f"A process of this machine serves {name} now: until that ends, it must answer.", "yellow")


def _show_enrolled(screen: Screen) -> None:
    """Show the enrolled robots.

    Raises:
        CliError: the file cannot be used.
    """
    try:
        robots = EnrolledKeys().robots()
    except (KeyFileError, OSError) as exc:
        raise CliError(f"The enrolled robots cannot be read: {exc}") from exc
    rows = ((name, _state(each), _networks(each), fingerprint(each.key)) for name, each in sorted(robots.items()))
    shown_robots = table("", ("robot", "", "network", "fingerprint"), rows)
    # It is compared and copied, so it stays whole.
    shown_robots.columns[-1].no_wrap = True
    screen.show(shown_robots)
    screen.data({"status": "success", "robots": {name: _facts(each) for name, each in sorted(robots.items())}})
    if not robots:
        screen.say("No robot is enrolled: a stop waits for every robot that was heard.")


def _state(robot: EnrolledRobot) -> Any:
    exempt = robot.exemption
    if exempt is None:
        return label("must answer", "green")
    why = f": {exempt.reason}" if exempt.reason else ""
    return label(plain(f"{exempt.state} since {utc(exempt.at)} by {exempt.by}{why}", 400), "yellow")


def _networks(robot: EnrolledRobot) -> str:
    return "; ".join(described(each) for each in robot.networks) or "every one (enrolled by an earlier release)"


def _facts(robot: EnrolledRobot) -> dict[str, Any]:
    exempt = robot.exemption
    return {
        "fingerprint": fingerprint(robot.key),
        "networks": [each.text for each in robot.networks],
        "exempt": exempt and {"state": exempt.state, "by": exempt.by, "reason": exempt.reason, "at": exempt.at},
    }


COMPARE = "Compare each with the fingerprint that `strands-robots doctor` shows at the robot's own machine."


def enroll(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str] | None, typer.Argument(metavar="DEVICE...", help="Which; else all found.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Accept a robot's new key, or its new network.")] = False,
    console: Annotated[str, typer.Option(help="Let a console elsewhere move hardware: its `keys console`.")] = "",
    retire: Retire = "",
    off: Off = "",
    forget: Forget = "",
    reason: Reason = "",
    listed: Listed = False,
    timeout: Timeout = 2.0,
) -> None:
    """Keep the public keys of robots: from then on only a signed answer counts."""
    change = _change_of(retire=retire, off=off, forget=forget, reason=reason)
    if change is not None or listed:
        if devices or console or replace or (change is not None and listed):
            raise CliError("--list, --retire, --off and --forget go with no other.", Exit.USAGE)
        if change is None:
            _show_enrolled(screen)
        else:
            _apply(screen, *change, reason, DEFAULT_TENANT if network.mesh else network.stated.stated_tenant)
        return
    if console:
        _enroll_console(screen, console)
        return
    wanted = [identifier("DEVICE", each) for each in devices or []]
    seconds = number("--timeout", timeout, above=0, high=60)
    _enroll_robots(screen, network, wanted, seconds, replace=replace)


def _enroll_robots(screen: Screen, network: Network, wanted: list[str], seconds: float, *, replace: bool) -> None:
    with network.joined() as there:
        reports = ask_lockouts(there, seconds, robots=wanted, look_s=seconds, signed=True)
        if not by_robot(reports):
            raise CliError(f"No robot answered. {there.reach}", Exit.SILENT, devices={}, absent=there.missing)
        try:
            outcome = enroll_all(reports, replace=replace)
        except (KeyFileError, OSError) as exc:
            raise CliError(f"Nothing was enrolled: {exc}") from exc
    absent = Enrolment(Enrolled.NO_KEY, said="no such robot is in reach")
    outcome |= {name: absent for name in wanted if name not in outcome}
    say_missing(screen, there)
    styles = {Enrolled.CHANGED_KEY: "bold red", Enrolled.TWO_KEYS: "bold red", Enrolled.NO_KEY: "yellow"}
    rows = (
        (name, label(each.outcome.value, styles.get(each.outcome, "green")), each.fingerprint, each.said)
        for name, each in outcome.items()
    )
    screen.show(table("", ("robot", "", "fingerprint", "what it said"), rows))
    facts = {
        name: {"outcome": each.outcome.value, "fingerprint": each.fingerprint, "said": each.said}
        for name, each in outcome.items()
    }
    several = [name for name, each in outcome.items() if each.outcome is Enrolled.TWO_KEYS]
    if several:
        raise CliError(
            plain(
                f"ALARM: {', '.join(several)} shows another key on each network: there are two robots of that id. Give "
                "one of them another id; --mesh enrolls the one on the mesh.",
                2000,
            ),
            devices=facts,
        )
    changed = [name for name, each in outcome.items() if each.outcome is Enrolled.CHANGED_KEY]
    if changed:
        raise CliError(
            plain(
                f"ALARM: {', '.join(changed)} shows another key than the enrolled one: it was set up anew, or another "
                f"machine answers in its name. If you know that it was set up anew: strands-robots enroll --replace.",
                2000,
            ),
            devices=facts,
        )
    if not any(each.outcome in (Enrolled.NEW, Enrolled.KNOWN) for each in outcome.values()):
        raise CliError("No robot showed a key.", Exit.SILENT, devices=facts)
    screen.data({"status": "success", "devices": facts, "absent": there.missing})
    screen.say(COMPARE)


def _enroll_console(screen: Screen, text: str) -> None:
    """Keep the key of a console on another machine, for the robots of this one."""
    public = ed25519.decode(text, 32)
    if public is None:
        raise CliError(
            f"--console must be the key that `strands-robots keys console` prints there, not {shown(text)}.", Exit.USAGE
        )
    mark = fingerprint(public)
    try:
        enrolled_consoles().enroll({f"console-{mark}": public})
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was enrolled: {exc}") from exc
    screen.data({"status": "success", "console": mark})
    screen.say(
        f"Enrolled the console {mark}: on the mesh it may move this user's robots, with their approval.", "green"
    )
