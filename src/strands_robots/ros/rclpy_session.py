"""Node in the ROS 2 that is sourced, with its context, executor and thread."""

from __future__ import annotations

import atexit
import logging
import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from strands_robots.ros.link import RosError

logger = logging.getLogger(__name__)

SPIN_S = 0.1
"""Longest time in seconds that the executor waits before it checks whether to end."""

NO_RCLPY = (
    "rclpy cannot be imported here: source a ROS 2 installation, Humble or later, "
    "and use the Python that it was built for."
)


def sourced() -> bool:
    """Return True where the Python client of a ROS 2 is on the path."""
    return find_spec("rclpy") is not None


def ros2(module: str) -> ModuleType:
    """Import a module of the ROS 2 client, or raise :class:`RosError`."""
    try:
        return import_module(module)
    except ImportError as exc:
        raise RosError(f"{NO_RCLPY} ({exc})") from exc


class RclpySession:
    """One node, spun by a thread of its own from construction to :meth:`close`.

    It has its own context: it installs no signal handler, writes no environment variable for its domain, and is
    independent of any other use of rclpy in the process.

    Raises:
        RosError: no ROS 2 is sourced, or its middleware did not start.
    """

    def __init__(self, name: str, domain_id: int) -> None:
        rclpy, contexts, executors = ros2("rclpy"), ros2("rclpy.context"), ros2("rclpy.executors")
        self._rclpy = rclpy
        self._context = contexts.Context()
        try:
            rclpy.init(context=self._context, domain_id=domain_id)
            self.node = rclpy.create_node(
                name,
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self._executor = executors.SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self.node)
        except Exception as exc:
            # Whatever the middleware raises; what has been made so far goes with the context.
            self._shut()
            raise RosError(f"ROS 2 could not be joined in domain {domain_id}: {exc}") from exc
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=f"rclpy-{name}", daemon=True)
        self._thread.start()
        # A thread that is still inside the client library at the interpreter's exit can abort the process.
        atexit.register(self.close)

    def later(self, action: Callable[[], None]) -> None:
        """Run ``action`` on the executor's thread, soon, and log what it raises.

        Requests go out there: a response that arrives before its request is registered would be lost.
        """

        def run() -> None:
            try:
                action()
            except Exception:
                logger.exception("A request to the ROS 2 graph failed.")

        self._executor.create_task(run)

    def close(self, parts: Sequence[Any] = ()) -> None:
        """End the thread and take the node off the graph; not from a callback.

        A second call does nothing; the interpreter's exit calls it for every session that is still open.

        Args:
            parts: parts that the node does not destroy by itself, such as its action clients.
        """
        atexit.unregister(self.close)
        if self._done.is_set():
            return
        self._done.set()
        self._thread.join(20 * SPIN_S)
        for each in parts:
            each.destroy()
        self._executor.shutdown(timeout_sec=SPIN_S)
        self.node.destroy_node()
        self._shut()

    def _shut(self) -> None:
        if self._context.ok():
            self._rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._done.is_set() and self._context.ok():
            try:
                self._executor.spin_once(timeout_sec=SPIN_S)
            except Exception:
                if self._done.is_set() or not self._context.ok():
                    return
                logger.exception("The executor of %s raised; it goes on.", self._thread.name)
                self._done.wait(SPIN_S)
