"""Import of LeRobot by one thread at a time.

LeRobot imports transformers, which replaces its own entry in ``sys.modules`` while it is being imported. A second
thread that imports it meanwhile, such as one that loads a policy while another loads an arm's driver, gets a module
without names.
"""

from __future__ import annotations

import threading
from importlib import import_module
from types import ModuleType

LEROBOT_IMPORTS = threading.RLock()
"""Held by every import of LeRobot in this package."""


def lerobot_import(name: str) -> ModuleType:
    """Import a module of LeRobot's while no other thread does.

    Raises:
        ModuleNotFoundError: LeRobot, or something that the module needs, is not installed.
    """
    with LEROBOT_IMPORTS:
        return import_module(name)
