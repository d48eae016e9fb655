"""Write the tables of settings, extras, old names and promises in the pages of docs/ from the code.

``python scripts/tables.py`` rewrites them in place; ``--check`` only compares them.
"""

from __future__ import annotations

import inspect
import re
import sys
import tomllib
from pathlib import Path

from strands_robots import moved, settings
from strands_robots.testing import promises

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = ROOT / "docs" / "reference.md"
FROM_05 = ROOT / "docs" / "from-0.5.md"
YOUR_ROBOT = ROOT / "docs" / "your-robot.md"

EXTRA_MEANINGS = {
    "device-connect": "the Device Connect networks (Zenoh, NATS), drivers and client",
    "sim": "the MuJoCo simulation and its pictures",
    "remote": "policies served over a WebSocket",
    "agent": "the Strands agent tool",
    "mcp": "the MCP server of all robots, `strands-robots mcp`",
    "bridge": "the framework's own MCP bridge (excludes `mcp`; not in `all`)",
    "dashboard": "the operator's page in a browser",
    "groot": "policies served by a GR00T server",
    "lerobot-async": "policies served by LeRobot's asynchronous inference (not in `all`)",
    "mesh": "the native Zenoh mesh, for robots without Device Connect",
    "iot": "the mesh over AWS IoT Core (MQTT 5)",
    "reachy": "Reachy Mini",
    "rosbridge": "ROS 1 and ROS 2 robots behind a rosbridge server",
    "ros2": "ROS 2 robots over bare DDS, without a ROS 2 installation",
    "record": "recordings of robots as MCAP files",
    "dataset": "LeRobot's datasets: episodes written, checked, and as leaders (not in `all`)",
    "lerobot": "real arms through LeRobot, and its checkpoints (brings torch; not in `all`)",
    "all": "everything but `bridge`, `dataset`, `lerobot` and `lerobot-async`",
}


def settings_table() -> str:
    rows = ["| variable | default | meaning |", "|---|---|---|"]
    for setting in settings.declared():
        domain = "" if setting.low is None else f" ({setting.low:g} to {setting.high:g})"
        default = f"`{setting.default}`" if setting.default else "unset"
        rows.append(f"| `{setting.name}` | {default}{domain} | {setting.meaning.replace('|', '&#124;')} |")
    return "\n".join(rows)


def unread_table() -> str:
    rows = ["| variable of 0.5 | here |", "|---|---|"]
    rows += [f"| `{name}` | {instead} |" for name, instead in sorted(settings.UNREAD.items())]
    return "\n".join(rows)


def extras_table() -> str:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = ["| extra | gives | brings |", "|---|---|---|"]
    for name, packages in project["optional-dependencies"].items():
        brought = ", ".join(re.split(r"[<>=]", package)[0] for package in packages)
        rows.append(f"| `{name}` | {EXTRA_MEANINGS[name]} | {brought} |")
    return "\n".join(rows)


def moved_table() -> str:
    rows = ["| in 0.5 | here |", "|---|---|"]
    homes = {**moved.MODULES, **moved.NAMES}
    rows += [f"| `{old}` | `{new.replace(':', '.')}` |" for old, new in sorted(homes.items())]
    return "\n".join(rows)


def gone_table() -> str:
    names: dict[tuple[str, str], list[str]] = {}
    for path, instead in moved.GONE.items():
        package, _, name = path.rpartition(".")
        names.setdefault((package, instead), []).append(f"`{name}`")
    rows = ["| package | names in 0.5 | instead |", "|---|---|---|"]
    rows += [f"| `{package}` | {', '.join(each)} | {instead} |" for (package, instead), each in sorted(names.items())]
    return "\n".join(rows)


def escaped(cell: str) -> str:
    return cell.replace("|", "&#124;").replace("*", r"\*").replace("__", r"\_\_")


def promises_table() -> str:
    rows = ["| check | promise | how it is checked | where to look |", "|---|---|---|---|"]
    for each in promises():
        cells = (f"`{each.name}`", each.text, inspect.getdoc(each.proof) or "", each.look)
        rows.append(f"| {' | '.join(map(escaped, cells))} |")
    return "\n".join(rows)


PAGES = {
    REFERENCE: (("settings", settings_table), ("unread", unread_table), ("extras", extras_table)),
    FROM_05: (("moved", moved_table), ("gone", gone_table)),
    YOUR_ROBOT: (("promises", promises_table),),
}


def rewritten(page: Path) -> str:
    text = page.read_text(encoding="utf-8")
    for name, table in PAGES[page]:
        pattern = rf"(<!-- table: {name} -->\n).*?(<!-- end -->)"
        text, found = re.subn(pattern, lambda m, t=table: f"{m[1]}{t()}\n{m[2]}", text, flags=re.DOTALL)
        if not found:
            raise SystemExit(f"{page.name} has no table marker for {name}.")
    return text


def main() -> int:
    behind = {page: wanted for page in PAGES if (wanted := rewritten(page)) != page.read_text(encoding="utf-8")}
    for page, wanted in behind.items():
        if "--check" in sys.argv:
            print(f"{page.name} is behind the code: run python scripts/tables.py")
        else:
            page.write_text(wanted, encoding="utf-8")
    return int("--check" in sys.argv and bool(behind))


if __name__ == "__main__":
    sys.exit(main())
