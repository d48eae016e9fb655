"""Application of the command line: functions become commands with flags."""

from __future__ import annotations

import inspect
import json
import logging
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from importlib import import_module
from inspect import Parameter
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, TypeVar

import typer

from strands_robots import __version__
from strands_robots.cli._compat import convert_when_needed
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit, Screen
from strands_robots.errors import StrandsRobotsError
from strands_robots.fleet.adapter import SOURCE
from strands_robots.utils import DISTRIBUTION, ValidationError, shown

Body = TypeVar("Body", bound=Callable[..., None])

Timeout = Annotated[float, typer.Option("--timeout", help="Seconds to wait for an answer.")]
Seconds = Annotated[float | None, typer.Option("--for", help="End after that many seconds.")]

WITHOUT_CHECK = ("stop", "estop", "doctor")
"""Commands that use what they can of a connection profile."""

WITHOUT_MESH = ("doctor",)
"""Commands that look at every network."""

_JSON = Parameter(
    "machine",
    Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[bool, typer.Option("--json", help="Machine-readable output, on stdout only.")],
)
_SERIAL = re.compile(r"/.|COM\d+\Z", re.IGNORECASE)
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def command(app: typer.Typer, name: str) -> Callable[[Body], Body]:
    """Register ``body(screen, [network], ...)`` as the command ``name``.

    A body with a ``network`` gets the flags that say which network, as a :class:`Network`.

    Args:
        app: where it is registered.
        name: the word on the command line.
    """

    def register(body: Body) -> Body:
        own = _parameters(body)
        network = own.pop("network", None) is not None
        del own["screen"]
        if network and "source" in own and own["source"].default == SOURCE:
            own["source"] = _profiles_name(own["source"])
        # A command may define a network flag of its own meaning, as serve does with --port.
        # Comprehensions here do not call anything `name`: Python 3.12.1 loses one that is a closure's as well.
        shared = {flag: each for flag, each in _parameters(Network).items() if network and flag not in own}
        if name in WITHOUT_MESH:
            shared.pop("mesh")
        parameters = [*own.values(), *shared.values(), _JSON]

        def run(**arguments: Any) -> None:
            screen = Screen(arguments.pop("machine"))
            if network:
                arguments["network"] = Network(**{flag: arguments.pop(flag) for flag in shared})

            def work() -> None:
                if network:
                    _use_profile(name, arguments)
                body(screen, **arguments)

            raise typer.Exit(int(_exit_code(screen, work)))

        run.__name__ = body.__name__
        run.__doc__ = body.__doc__
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # what Typer reads
        app.command(name)(run)
        return body

    return register


def _use_profile(name: str, arguments: dict[str, Any]) -> None:
    """Refuse an unusable connection profile; take the caller's name from it.

    A stop is not refused for what it does not need of the profile, the doctor reports it, and the default profile is
    looked at only by what uses a network.
    """
    network: Network = arguments["network"]
    if network.profile is not None and name not in WITHOUT_CHECK:
        network.check()
    if "source" in arguments and arguments["source"] is None:
        arguments["source"] = network.caller()


def _profiles_name(source: Parameter) -> Parameter:
    """Return ``--as`` without a default, so that one that is given is told from none."""
    (option,) = source.annotation.__metadata__
    shown_default = copy(option)
    shown_default.show_default = SOURCE
    return source.replace(default=None, annotation=Annotated[str | None, shown_default])


def _parameters(function: Callable[..., Any]) -> dict[str, Parameter]:
    signature = inspect.signature(function, eval_str=True)
    return {name: each.replace(kind=Parameter.KEYWORD_ONLY) for name, each in signature.parameters.items()}


def assignments(arguments: Iterable[str]) -> dict[str, Any]:
    """Parse ``key=value`` arguments; a value is JSON where possible, else text.

    ``speed=1.5`` is a number, ``name='"1.5"'`` the text 1.5, ``instruction=wave`` the text wave.

    Raises:
        ValidationError: no ``=``, a key that is no name, a key given twice, or a number that is not finite.
    """
    values: dict[str, Any] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or not _KEY.match(key):
            raise ValidationError(f"arguments must be key=value with a name as key, not {shown(argument)}.")
        if key in values:
            raise ValidationError(f"{key} is given twice.")
        values[key] = _value(key, text)
    return values


def parse_ports(ports: Iterable[str]) -> tuple[int | None, str | None]:
    """Return the TCP port and the serial port among the values of ``--port``.

    Raises:
        ValidationError: one that is neither, or two of a kind.
    """
    tcp: int | None = None
    serial: str | None = None
    for port in ports:
        if _SERIAL.match(port):
            if serial is not None:
                raise ValidationError(f"--port names two serial ports: {serial} and {port}.")
            serial = port
        elif port.isdecimal() and 1 <= int(port) <= 65535:
            if tcp is not None:
                raise ValidationError(f"--port names two numbers: {tcp} and {port}.")
            tcp = int(port)
        else:
            raise ValidationError(
                f"--port must be a serial port such as /dev/ttyACM0 or a number from 1 to 65535, not {shown(port)}."
            )
    return tcp, serial


def _value(key: str, text: str) -> Any:
    def refuse(constant: str) -> float:
        raise ValidationError(f"{key} must be finite; JSON has no {constant}.")

    try:
        value = json.loads(text, parse_constant=refuse)
    except ValidationError:
        raise
    except (ValueError, RecursionError):
        return text
    if isinstance(value, float) and not math.isfinite(value):
        raise ValidationError(f"{key} must be finite, not {shown(text)}.")
    return value


def _log_to_stderr() -> None:
    """Log our warnings and everybody's errors to stderr.

    What a library warns of, such as asyncio's ``eof_received()`` of each TLS connection that ends, a user of ours can
    neither judge nor mend.
    """
    logging.captureWarnings(True)
    handler = logging.StreamHandler()
    handler.addFilter(lambda record: record.levelno >= logging.ERROR or record.name.startswith("strands_robots"))
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", handlers=[handler])


def _exit_code(screen: Screen, body: Callable[[], None]) -> Exit:
    """Run ``body``, report its failure on the screen, and return the exit code."""
    _log_to_stderr()
    try:
        body()
    except CliError as failure:
        screen.fail(failure)
        return failure.code
    except ValidationError as refused:
        screen.fail(CliError(str(refused), Exit.USAGE))
        return Exit.USAGE
    except (StrandsRobotsError, OSError) as failed:
        screen.fail(CliError(str(failed)))
        return Exit.REFUSED
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    return Exit.OK


IMPORT_PACKAGE = "strands_robots"

_OWNED = f"{IMPORT_PACKAGE}/__init__.py".encode()
_OWNS = re.compile(rb"^(\.\./)*" + re.escape(_OWNED) + rb"\b", re.MULTILINE)

# Lists of installed files, by the folder that holds them.
_LISTS = {".dist-info": "RECORD", ".egg-info": "installed-files.txt"}


def other_owners(path: Sequence[str] | None = None) -> list[str]:
    """Return every other distribution that installs our import package."""
    found = set()
    for folder in dict.fromkeys(sys.path if path is None else path):
        for installed in _owning(folder or os.curdir):
            from importlib.metadata import Distribution  # noqa: PLC0415 - rarely needed, and slow to load

            distribution = Distribution.at(installed)
            name = distribution.metadata["Name"]
            if name and name.lower().replace("_", "-") != DISTRIBUTION:
                found.add(f"{name} {distribution.version}")
    return sorted(found)


def owner_remedy(others: Sequence[str]) -> str:
    """Return the commands that make this project the only owner of its import."""
    names = " ".join(other.split()[0] for other in others)
    return f"pip uninstall {names}, then reinstall {DISTRIBUTION} (pip install --force-reinstall --no-deps)"


def _owning(folder: str) -> Iterator[Path]:
    """Yield the metadata folders of the distributions that install our package."""
    # A folder that is gone, or a list that cannot be read, must not keep a command, least of all a stop, from running.
    with suppress(OSError):
        for name in os.listdir(folder):  # noqa: PTH208 - a name is checked in a tenth of a path's time
            listing = _LISTS.get(name[-10:])
            if listing is None:
                continue
            with suppress(OSError):
                files = Path(folder, name, listing).read_bytes()
                if _OWNED in files and _OWNS.search(files):
                    yield Path(folder, name)


COMMANDS = {
    "serve": ("serve",),
    "peers": ("peers", "call", "fleets"),
    "stop": ("stop", "estop"),
    "safety_controller": ("safety-controller",),
    "resume": ("resume", "lockout", "grant", "take", "enroll"),
    "watch": ("watch",),
    "dashboard": ("dashboard", "demo"),
    "teleop": ("teleop", "calibrate", "replay"),
    "record": ("record",),
    "dataset": ("dataset",),
    "policy": ("policy", "eval"),
    "audit": ("audit",),
    "keys": ("keys", "mesh"),
    "doctor": ("doctor",),
    "conform": ("conform", "new"),
    "mcp": ("mcp",),
}
"""Words of the command line, by the module that has them."""

GROUPS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "policy": ("Look at trained policies before a robot moves by them.", ("check", "bench")),
    "dataset": ("Episodes to train by, in LeRobot's format.", ("record", "from-mcap", "check", "show")),
    "audit": ("The safety record of this machine.", ("tail", "show", "verify")),
    "keys": ("Keys that free robots and sign their stops.", ("resume", "estop", "console", "mcp")),
    "mesh": ("The native mesh: certificates and access rules.", ("keys",)),
    "mesh keys": ("Certificates for a mesh that leaves this machine.", ("init", "issue", "acl")),
}
"""Words that stand before other ones: what they are about, and those."""

FUNCTIONS = {"eval": "evaluate", "from-mcap": "from_mcap"}
"""Functions whose name is not that of their command."""

HELP = """Robots on Device Connect and the native mesh: serve one, find them, drive them, and stop them.

Without network flags everything stays on this machine. Exit codes: 0 done, 1 refused or failed,
2 wrong usage, 3 no answer, 130 Ctrl-C."""


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{DISTRIBUTION} {__version__}")
        raise typer.Exit


def _start(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_print_version, help="Print name and version, and exit."),
    ] = False,
) -> None:
    others = [] if version else other_owners()
    if others:
        owners = f"{', '.join(others)} also installs the import package strands_robots"
        typer.echo(f"Warning: {owners}, so its code may run instead. Remedy: {owner_remedy(others)}.", err=True)


def build(word: str = "") -> typer.Typer:
    """Build the application.

    Args:
        word: the command that is wanted; then only its module is loaded, which saves a third of a command's start.
    """
    convert_when_needed()
    app = typer.Typer(
        name="strands-robots",
        help=HELP,
        no_args_is_help=True,
        add_completion=False,
        # A traceback with local variables could print keys.
        pretty_exceptions_enable=False,
    )
    app.callback()(_start)
    wanted = [module for module, words in COMMANDS.items() if word in words] or COMMANDS
    for name in wanted:
        module = import_module(f"strands_robots.cli.{name}")
        for each in COMMANDS[name]:
            _add(app, module, each)
    return app


def _add(app: typer.Typer, module: ModuleType, words: str) -> None:
    """Add a command, or a group of them, of a module."""
    name = words.rpartition(" ")[2]
    if words not in GROUPS:
        command(app, name)(getattr(module, FUNCTIONS.get(words, name.replace("-", "_"))))
        return
    about, members = GROUPS[words]
    group = typer.Typer(no_args_is_help=True, help=about)
    for each in members:
        _add(group, module, f"{words} {each}")
    app.add_typer(group, name=name)
