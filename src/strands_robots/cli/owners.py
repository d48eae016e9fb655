"""Other distributions that install our import package.

Every command looks for them, so their lists of installed files are searched as bytes, and ``importlib.metadata`` is
loaded only where one names the package.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from strands_robots.utils import DISTRIBUTION

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
