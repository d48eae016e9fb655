"""The command line put together."""

from __future__ import annotations

import typer

from strands_robots.cli import (
    audit,
    demo,
    doctor,
    estop,
    fleet,
    grant,
    keys,
    mesh,
    record,
    resume,
    safety_controller,
    serve,
    teleop,
    watch,
)

HELP = """Robots on Device Connect: serve one, find them, drive them, and always stop them.

Without network flags everything stays on this machine. Exit codes: 0 done, 1 refused or failed,
2 wrong usage, 3 nobody answered, 130 Ctrl-C."""


def build() -> typer.Typer:
    """The application with every command."""
    app = typer.Typer(
        name="strands-robots",
        help=HELP,
        no_args_is_help=True,
        add_completion=False,
        # A traceback with local variables could print keys.
        pretty_exceptions_enable=False,
    )
    for module in (
        serve,
        fleet,
        estop,
        safety_controller,
        resume,
        watch,
        teleop,
        record,
        grant,
        audit,
        keys,
        mesh,
        doctor,
        demo,
    ):
        module.register(app)
    return app
