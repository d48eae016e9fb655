"""A recording on its robot's network: its state, and a person's words as verbs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from strands_robots import settings
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.own_robot import device_of, peer_of
from strands_robots.cli.recording_state import BEGIN, END, KEEP, REDO, RecordingState, Said
from strands_robots.cli.serve import PAGE_CALLER, added
from strands_robots.envelope import Envelope, success, text_of
from strands_robots.safety.authorization import Authorization
from strands_robots.safety.gate import gate_of
from strands_robots.safety.orders import COMES_UP_LOCKED
from strands_robots.safety.scope import SCOPE
from strands_robots.utils import MissingExtraError, ValidationError
from strands_robots.verb_declaration import verb

RECORDER = "recorder"
"""Kind of the device, on every network."""

ROBOT_FIRST_S = 0.3
"""Seconds in which a robot that an emergency stop locks as well is seen to be stopped, and ends the attempt itself."""

ANSWERED_S, ANSWERED_MESH_S = 1.0, 2.5
"""Seconds in which a stop that ended the recording is answered: its lockout is written first.

On the mesh it is asked again after 1.5 s, where its answer came before its presence."""


PAGE_NAMES = (PAGE_CALLER, f"{PAGE_CALLER}-*", f"*__{PAGE_CALLER}-*")
"""Names of the page: on Device Connect, on the mesh, and there under the name of its certificate."""


class RecorderDevice:
    """A recording, as callers see and steer it.

    What begins a motion is one: ``beginEpisode`` passes lease, lockout and approval. The other words move nothing.
    A stop ends the recording, and the attempt that runs, which halts the robot.

    Args:
        state: of the recording.
        robot: that is recorded, by its name on the network.
        task: in words.
    """

    device_type = RECORDER

    def __init__(self, state: RecordingState, robot: str, task: str) -> None:
        self.tool_name_str = RECORDER
        self._state, self._robot, self._task = state, robot, task
        state.locked = self._locked

    @verb(motion=False)
    def get_recording(self) -> dict[str, Any]:
        """Read how far the recording is, and the verbs that fit now.

        Returns:
            robot, task, state, episode, episodes, saved, can, said; of an attempt seconds, frames, hz and age_ms
        """
        return {"robot": self._robot, "task": self._task, **self._state.facts()}

    @verb(name=BEGIN)
    def begin_episode(self) -> Envelope:
        """Begin the next episode: the robot is led from now on."""
        return self._state.press(BEGIN, Said.SUCCESS)

    @verb(motion=False, changes=True, name=KEEP)
    def keep_episode(self, success: bool) -> Envelope:
        """End the episode and save it.

        Args:
            success: whether it was one
        """
        return self._state.press(KEEP, Said.SUCCESS if success else Said.FAILURE)

    @verb(motion=False, changes=True, name=REDO)
    def redo_episode(self) -> Envelope:
        """End the episode and drop it, to do it again."""
        return self._state.press(REDO, Said.REDO)

    @verb(motion=False, changes=True, name=END)
    def end_recording(self) -> Envelope:
        """End the recording; an episode that runs is dropped. What is saved stays."""
        return self._state.press(END, Said.END)

    def get_task_status(self) -> dict[str, Any]:
        """Return an attempt as a task, until its robot is halted."""
        text = self._state.summary
        return success(text, task_status="running" if self._state.runs else "idle", instruction=text)

    def halt(self, reason: str = "") -> None:
        """End the recording; its status tells when the robot of an attempt is halted."""
        if reason is COMES_UP_LOCKED:
            # By a stop of before this recording: it waits for the resume. No stop of others has this very text.
            return
        # A lockout of before has let no attempt begin, so the first one that is seen is this stop's.
        waits = not self._state.halting and self._robot_is_stopped_as_well
        why = "the recording was stopped" + (f": {reason}" if reason else "")
        self._state.halt(why, ROBOT_FIRST_S if waits else 0.0)

    @property
    def _robot_is_stopped_as_well(self) -> bool:
        """True while an emergency stop of more than named robots locks it."""
        locked = gate_of(self).lockout(RECORDER)
        return locked is not None and not locked.get(SCOPE, {}).get("only")

    def _locked(self) -> str:
        locked = gate_of(self).lockout(BEGIN)
        return "" if locked is None else text_of(locked).removeprefix(f"{BEGIN} is refused: ")


@contextmanager
def recorder_served(
    screen: Screen, network: Network, robot: str, state: RecordingState, task: str, *, on_mesh: bool, needed: bool
) -> Iterator[None]:
    """Have a recording on the network of its robot, for the block.

    Args:
        screen: where its id is told, or why it has none.
        network: the flags.
        robot: the robot's name on the network, which its id is made of.
        state: of the recording.
        task: in words.
        on_mesh: the robot is on the mesh, else on Device Connect.
        needed: nothing else could end an attempt.

    Raises:
        CliError: it is not on the network, and is needed there.
    """
    device, name = RecorderDevice(state, robot, task), f"{RECORDER}-{robot.replace('/', '-')}"
    grant_page(name)
    with ExitStack() as stack:
        try:
            if on_mesh:
                stack.enter_context(peer_of(device, name, RECORDER))
            else:
                stack.enter_context(device_of(network, network.link(), recorder_driver(device, name), name))
        except (CliError, ValidationError, MissingExtraError) as absent:
            why = f"The page has no buttons for this recording: {str(absent).removeprefix(NOT_SERVED)}"
            if needed:
                raise CliError(f"{why} --episode-s ends each attempt by its time.") from absent
            screen.say(why, "yellow")
        else:
            screen.say(f"The page has its buttons: {name}.")
        try:
            yield
        finally:
            if state.halting:
                # It leaves its network once the stop that ended it is answered.
                time.sleep(ANSWERED_MESH_S if on_mesh else ANSWERED_S)


NOT_SERVED = "The robot is not on the network: "


def grant_page(name: str) -> None:
    """Approve the begin for the page: who starts a recording wants its robot led."""
    page = [f"{BEGIN}@{name}:{each}" for each in PAGE_NAMES]
    settings.put("STRANDS_ROBOT_COMMAND_ALLOW", added(None, "STRANDS_ROBOT_COMMAND_ALLOW", page))


def recorder_driver(device: RecorderDevice, name: str) -> Any:
    """Return the driver of a recording, whose callers are asked as for hardware."""
    from strands_robots.device_connect.robot_driver import RobotDeviceDriver  # noqa: PLC0415 - an extra

    allowed = Authorization(hardware=True, read_list=_callers, robot=name)
    return RobotDeviceDriver(device, authorization=allowed)


def _callers(setting: str) -> Sequence[str]:
    """Return the list of a setting; the page, where nobody stated callers."""
    stated = settings.items(setting)
    return stated or ([PAGE_CALLER] if setting == "DEVICE_CONNECT_RPC_ALLOW" else [])
