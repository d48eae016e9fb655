"""The framework's package, run when one of its own names is first used.

``device_connect_edge/__init__.py`` imports its runtime, pydantic's models and OpenTelemetry, ten times the time of the
messaging package, which is all that a client needs.
"""

from __future__ import annotations

import sys
import threading
from importlib.util import find_spec, module_from_spec
from typing import Any

PACKAGE = "device_connect_edge"


def load_when_used() -> None:
    """Have the framework's package run at the first use of a name in it; its submodules import without that.

    For processes of our own alone: an application may rely on what the import does. Nothing happens where the package
    is imported already or is not installed.
    """
    spec = None if PACKAGE in sys.modules else find_spec(PACKAGE)
    if spec is None or spec.loader is None:
        return
    module, loader = module_from_spec(spec), spec.loader
    running = threading.RLock()

    def run_then_get(name: str) -> Any:
        with running:
            if vars(module).pop("__getattr__", None) is not None:
                loader.exec_module(module)
        return getattr(module, name)

    vars(module)["__getattr__"] = run_then_get
    sys.modules[PACKAGE] = module
