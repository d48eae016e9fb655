"""``conform``: check a robot. ``new``: write a package with one that conforms."""

from __future__ import annotations

import keyword
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.app import assignments
from strands_robots.cli.conform_process import ConformRequest, conform_apart
from strands_robots.cli.motion_approval import FLAG, LET_GO, MotionList, connected, lines_of, parse_motion
from strands_robots.cli.network import Network, answering
from strands_robots.cli.output import CliError, Exit, Screen
from strands_robots.cli.serve import options_of_file
from strands_robots.utils import ValidationError, choice, identifier, number, shown

if TYPE_CHECKING:
    from strands_robots.testing import CheckResult, ConformanceReport, LongMotion, Subject

TIERS = ("bronze", "silver", "gold", "platinum")

_STYLES = {"passed": "green", "exempt": "cyan", "not proven": "yellow"}


def conform(
    screen: Screen,
    network: Network,
    *,
    target: Annotated[
        str | None,
        typer.Argument(help="module:NAME of a Subject, or of what makes the robot; a robot's name; or an id."),
    ] = None,
    tier: Annotated[
        str, typer.Option("--tier", help="The highest that is checked: bronze, silver, gold or platinum.")
    ] = "gold",
    list_them: Annotated[bool, typer.Option("--list", help="List the checks with their promises, and end.")] = False,
    only: Annotated[list[str] | None, typer.Option("--only", help="A check, such as silver.halts (repeat).")] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="An option of a robot that was named.", metavar="KEY=VALUE"),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="File of the robot's options: .json, .toml or LeRobot's .yaml.")
    ] = None,
    limit: Annotated[
        float, typer.Option("--limit", help="Seconds for one check; a process that takes longer is ended.")
    ] = 120.0,
    live: Annotated[
        bool, typer.Option("--live", help="TARGET is the id of a robot in reach; without --motion it is not moved.")
    ] = False,
    motion: Annotated[
        str | None,
        typer.Option("--motion", help="Move it by this, once you approve the list.", metavar='"VERB KEY=VALUE ..."'),
    ] = None,
    approve_motions: Annotated[
        str | None, typer.Option(FLAG, help="Approve the printed list, by its digest.", metavar="DIGEST")
    ] = None,
) -> None:
    """Check a robot on its emulated bus, where it moves. Exits 1 on a failure."""
    if list_them:
        _list(screen)
        return
    if target is None:
        raise ValidationError("TARGET must say which robot is checked; --list lists the checks.")
    most = choice("--tier", tier, TIERS).upper()
    limit_s = number("--limit", limit, low=1, high=3600)
    chosen = _Chosen(most, tuple(only or ()), None if motion is None else parse_motion(motion), approve_motions)

    def tell(result: CheckResult) -> None:
        screen.data({"event": "checked", "check": result.check, "mark": result.mark.value, "said": result.said})
        style = _STYLES.get(result.mark.value, "bold red")
        screen.say(f"{result.mark.value:>16}  {result.check}  {result.said}", style)

    if live:
        report = _live(screen, network, target, chosen, tell)
    else:
        if network != Network():
            raise ValidationError("a network is stated for a robot in reach; give --live with it.")
        stated = {} if config is None else options_of_file(config, target)
        request = ConformRequest(target, stated | assignments(options or []), most, chosen.only, limit_s=limit_s)
        report = conform_apart(_approved(screen, request, chosen), tell)
    screen.data({"event": "report", **report.facts()})
    for line in report.words().splitlines():
        screen.say(line)
    if report.failed:
        names = ", ".join(each.check for each in report.failed)
        raise CliError(f"{report.name} does not keep {len(report.failed)} of its promises: {names}.")


def _list(screen: Screen) -> None:
    """Print each check with its promise, by tier."""
    from strands_robots.testing import promises  # noqa: PLC0415 - loads both networks

    screen.data({"event": "checks", "checks": [each.facts() for each in promises()]})
    tier = ""
    for each in promises():
        if each.tier.label != tier:
            tier = each.tier.label
            screen.say(tier, "bold")
        screen.say(f"  {each.name}: {each.text}")


@dataclass(frozen=True, slots=True)
class _Chosen:
    """Checks that were chosen, and the motion for them."""

    most: str
    only: tuple[str, ...]
    motion: LongMotion | None
    approval: str | None

    def motions(self) -> list[str]:
        """Return the sentences of the list to approve; none without a motion."""
        from strands_robots.testing.live import MOTIONS, WRONG_ARGUMENTS  # noqa: PLC0415 - loads both networks

        if self.motion is None:
            return []
        starts = sum(times for name, times in MOTIONS.items() if self._checks(name))
        return lines_of(self.motion, starts, wrong=any(map(self._checks, WRONG_ARGUMENTS)))

    def _checks(self, name: str) -> bool:
        from strands_robots.testing import Tier, promises  # noqa: PLC0415 - as above

        return any(name == each.name for each in promises(Tier[self.most])) and (not self.only or name in self.only)


def _approved(screen: Screen, request: ConformRequest, chosen: _Chosen) -> ConformRequest:
    """Return the request, for real hardware once its motions are approved."""
    from strands_robots.robot import counts_as_hardware  # noqa: PLC0415 - heavy, and needed by this command alone

    # The name of the robot for a target that makes one by it, such as strands_robots:Robot.
    named = (request.target, str(request.options.get("name", "")))
    if not (any(map(counts_as_hardware, named)) or request.options.get("mode") == "real"):
        if chosen.motion is not None:
            raise ValidationError("--motion is for real hardware and for --live; a Subject has its motion.")
        return request
    if request.target == "reachy_mini" and (host := settings.raw("REACHY_HOST")):
        # The check puts the settings aside, and the list has to name the robot that moves.
        request = replace(request, options={"host": host, **request.options})
    MotionList(request.target, [connected(request.options), *chosen.motions(), LET_GO]).approve(screen, chosen.approval)
    motion = None if chosen.motion is None else asdict(chosen.motion)
    return replace(request, hardware=True, motion=motion)


def _live(
    screen: Screen, network: Network, robot: str, chosen: _Chosen, tell: Callable[[CheckResult], None]
) -> ConformanceReport:
    from strands_robots.testing import Tier, conform_live  # noqa: PLC0415 - loads both networks

    robot = identifier("TARGET", robot)
    if moved := chosen.motions():
        # With its network: another one may have a robot of the same id.
        MotionList(f"{robot}{network.flags}", moved).approve(screen, chosen.approval)
    try:
        with network.joined() as there, answering(there, robot, ""):
            return conform_live(there, robot, Tier[chosen.most], motion=chosen.motion, only=chosen.only, report=tell)
    except KeyboardInterrupt:
        if not moved:
            raise
        stop = f"strands-robots stop {robot}{network.flags}"
        raise CliError(f"Interrupted. To be sure that {robot} stands: {stop}", Exit.INTERRUPTED, stop=stop) from None


def subject_of(target: str, options: dict[str, Any]) -> Subject:
    """Return the subject that a target names.

    Raises:
        ValidationError: it cannot be loaded.
    """
    from strands_robots.robot import LEROBOT  # noqa: PLC0415 - heavy, and needed by this command alone
    from strands_robots.testing import Subject  # noqa: PLC0415 - as above
    from strands_robots.testing.built_in import built_in  # noqa: PLC0415 - as above

    module, colon, attribute = target.partition(":")
    if target == "reachy_mini" or target.startswith(LEROBOT):
        options = {**options, "mode": "real"}
    if not colon or target.startswith(LEROBOT):
        return built_in(target, **options)
    # As a module that is run: the package that is being written need not be installed.
    sys.path.insert(0, str(Path.cwd()))
    try:
        named = getattr(import_module(module), attribute)
        made = named(**options) if callable(named) else named
    except Exception as exc:
        raise ValidationError(f"{shown(target)} cannot be made: {type(exc).__name__}: {exc}") from exc
    if isinstance(made, Subject):
        return made
    if not callable(named):
        raise ValidationError(f"{shown(target)} must be a Subject, or make one or a robot, not {shown(named)}.")
    first = [made]
    return Subject(lambda: first.pop() if first else named(**options), name=attribute)


TEMPLATE = Path(__file__).parent / "new_robot"


def new(
    screen: Screen,
    *,
    name: Annotated[str, typer.Argument(help="Of the robot, such as my_robot: lower case letters, digits and _.")],
    folder: Annotated[
        Path | None, typer.Option("--folder", help="Where it is written; it must not exist. By default the name.")
    ] = None,
) -> None:
    """Write a package with a robot of your own, its emulated bus and its tests."""
    from strands_robots.robot import PLUG_INS  # noqa: PLC0415 - heavy, and needed by this command alone

    if not re.fullmatch(r"[a-z][a-z0-9_]{0,49}", name) or keyword.iskeyword(name):
        raise ValidationError(f"name must begin with a letter and have a-z, 0-9 and _ alone, not {shown(name)}.")
    if name in PLUG_INS.built_in:
        raise ValidationError(f"name must not be {name}: it is a built-in robot.")
    if find_spec(name) is not None:
        raise ValidationError(f"name must be free: there is a package {name} already.")
    root = folder or Path(name)
    if root.exists():
        raise ValidationError(f"--folder must not exist: {root} does.")
    words = {"name": name, "title": name.replace("_", " "), "Name": "".join(map(str.capitalize, name.split("_")))}
    for source in sorted(TEMPLATE.rglob("*.tmpl")):
        relative = str(source.relative_to(TEMPLATE)).removesuffix(".tmpl").replace("NAME", name)
        written = root / relative
        written.parent.mkdir(parents=True, exist_ok=True)
        written.write_text(Template(source.read_text(encoding="utf-8")).substitute(words), encoding="utf-8")
        screen.say(f"  {written}")
    screen.data({"status": "success", "folder": str(root)})
    screen.say(f"cd {root} && pip install -e . pytest && pytest    # {root}/README.md has the rest", "bold")
