"""How a function becomes a command: ``--json`` and the network flags added, its failures turned into exit codes."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable
from inspect import Parameter
from typing import Annotated, Any, TypeVar

import typer

from strands_robots.cli.network import NETWORK_OPTIONS, Network
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.utils import MissingExtraError, ValidationError

Body = TypeVar("Body", bound=Callable[..., None])

_JSON = Parameter(
    "machine",
    Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[bool, typer.Option("--json", help="Machine-readable output, on stdout alone.")],
)


def command(app: typer.Typer, name: str, *, network: bool = False) -> Callable[[Body], Body]:
    """Register ``body(screen, [network], ...)`` as the command ``name``.

    Args:
        app: where it is registered.
        name: the word on the command line.
        network: give it the flags that say which network, as a :class:`Network`.
    """

    def register(body: Body) -> Body:
        asked = inspect.signature(body, eval_str=True).parameters.values()
        own = [each.replace(kind=Parameter.KEYWORD_ONLY) for each in asked if each.name not in ("screen", "network")]
        # A command may read a flag of the network in a way of its own.
        shared = [each for each in NETWORK_OPTIONS if network and each.name not in {mine.name for mine in own}]
        parameters = [*own, *shared, _JSON]

        def run(**given: Any) -> None:
            screen = Screen(given.pop("machine"))
            if network:
                given["network"] = Network(**{each.name: given.pop(each.name) for each in shared})
            raise typer.Exit(int(outcome(screen, lambda: body(screen, **given))))

        run.__name__ = body.__name__
        run.__doc__ = body.__doc__
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # what Typer reads
        app.command(name)(run)
        return body

    return register


def outcome(screen: Screen, body: Callable[[], None]) -> Exit:
    """Run ``body`` and tell its end: 0, or the code of what went wrong, said on the screen."""
    _quiet_libraries()
    try:
        body()
    except Failure as failure:
        screen.fail(failure)
        return failure.code
    except ValidationError as refused:
        screen.fail(Failure(str(refused), Exit.USAGE))
        return Exit.USAGE
    except (MissingExtraError, ConnectionError) as missing:
        screen.fail(Failure(str(missing)))
        return Exit.REFUSED
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    return Exit.OK


def _quiet_libraries() -> None:
    """Keep the libraries' reports of routine events off the terminal; warnings still get through."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    # The framework warns of extras that nothing here uses.
    logging.getLogger("device_connect_edge").setLevel(logging.ERROR)
