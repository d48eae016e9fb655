"""The native mesh's side of ``safety-controller --mesh``."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from strands_robots.fleet.mesh.discovery import LOOK_S
from strands_robots.fleet.mesh.lockouts import lockable_peers
from strands_robots.fleet.mesh.standing import MeshReports, mesh_network
from strands_robots.fleet.stop_answers import stop_outcome
from strands_robots.safety.answers import Answer, OnProgress, Press, Presses, Progress, StopReport
from strands_robots.safety.controller import DEADLINE_S
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster import OnReport, Sending
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.statements import ALARM, enrolled_peers, stop_distrust
from strands_robots.safety.stop_roster import READ_WITHIN_S, robots_known_at
from strands_robots.safety.stopping import explain

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh


class MeshController:
    """A safety controller whose stops and check-ins travel on the mesh.

    Args:
        mesh: the peer that sends them, under its own id; it may have joined just now.
        signing_key: Ed25519 private key, for fleets that act on signed stops only.
    """

    def __init__(self, mesh: Mesh, signing_key: Any = None) -> None:
        from strands_robots.mesh.transport.config import DISCOVERY_S  # noqa: PLC0415 - the network is loaded when it is used

        self._mesh = mesh
        self._key = signing_key
        self._presses = Presses()
        self._keys = enrolled_peers()
        self._named: dict[str, frozenset[str]] = {}
        self.controller_id, self.network = mesh.peer_id, mesh_network()
        self.sending = Sending(signed=signing_key is not None)
        self._reports = MeshReports(mesh)
        self._reports.begin()
        self._known_at = time.monotonic() + DISCOVERY_S

    @property
    def link_up(self) -> bool:
        """True while this peer is on the mesh, and linked to its hub."""
        from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used

        return self._mesh.alive and not session.cut_off()

    def press(self, estop_id: str) -> Press:
        """Note the moment of a press, from which its answers are counted."""
        return self._presses.note(estop_id)

    def check_in_every(self, interval_s: float) -> None:
        """Check in with the robots that need a live controller."""
        self._mesh.check_in_every(interval_s, self._key)

    def stop(
        self,
        expected: Collection[str] = (),
        reason: str = "",
        *,
        estop_id: str = "",
        more: bool = False,
        on_progress: OnProgress = lambda progress: None,
        on_report: OnReport = lambda report: None,
        scope: Scope = EVERY_ROBOT,
    ) -> StopReport:
        """Stop every peer of the mesh, or those of ``scope``, and wait at most 3 s.

        Where no robot in the scope is there, every robot is stopped.
        """
        epoch = estop_id or new_epoch()
        pressed = self.press(epoch)
        self._named[epoch] = frozenset(expected) | scope.only
        answers: dict[str, Answer] = {}
        alarms: dict[str, str] = {}
        widened: list[bool] = []

        def note(replies: list[dict[str, Any]]) -> None:
            for reply in replies:
                name, why = str(reply["responder_id"]), stop_distrust(reply, self._keys)
                if why.startswith(ALARM):
                    alarms[name] = why
                elif name not in answers or answers[name].stopped is not True or answers[name].claimed:
                    answers[name] = _answer(name, reply, (time.monotonic() - pressed.at) * 1000, claimed=bool(why))
            silent = tuple(sorted(self._named[epoch] - answers.keys()))
            elapsed = (time.monotonic() - pressed.at) * 1000
            on_progress(
                Progress(
                    epoch,
                    dict(answers),
                    silent,
                    self.link_up,
                    elapsed,
                    alarms=dict(alarms),
                    scope=scope,
                    widened=bool(widened),
                )
            )

        until = time.monotonic() + DEADLINE_S
        self._reports.inbox.open(epoch, on_report)
        # On a thread: a disk that hangs delays no sending.
        reading = threading.Thread(target=self._load_keys, name="enrolled keys", daemon=True)
        reading.start()

        def send() -> list[dict[str, Any]]:
            return self._mesh.emergency_stop(
                self._key,
                reason=reason,
                estop_id=epoch,
                on_answers=note,
                scope=scope,
                remembers=robots_known_at(mesh_network),
                on_widened=lambda: widened.append(True),
            )

        replies = send()
        if time.monotonic() < self._known_at:
            # Peers that this one did not know yet have stopped, and were not waited for.
            time.sleep(max(0.0, self._known_at - time.monotonic()))
            replies = send()
        up = self.link_up
        # Without a hub nothing left; a stop that goes on is sent again in the moment it is back.
        while not up and not self.link_up and time.monotonic() < until:
            time.sleep(LOOK_S)
        self._reports.inbox.close(epoch)
        reading.join(READ_WITHIN_S)
        # By the keys of now: a robot may have been enrolled since the last stop.
        answers.clear()
        note(replies)
        expected = self._named.pop(epoch)
        robots = {*expected, *lockable_peers(self._mesh)}
        told = {name: each for name, each in answers.items() if name in robots}
        return StopReport(
            epoch,
            {name: each for name, each in told.items() if each.stopped is True and not each.claimed},
            {name: each for name, each in told.items() if each.stopped is not True},
            {},
            tuple(sorted(expected - told.keys() - alarms.keys())),
            up,
            (time.monotonic() - pressed.at) * 1000,
            claimed={name: each for name, each in told.items() if each.stopped is True and each.claimed},
            alarms=alarms,
            scope=scope,
            widened=bool(widened),
        )

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer; the mesh asks those in reach by itself."""
        named = self._named.get(estop_id)
        if named is None:
            return False
        self._named[estop_id] = named | frozenset(names)
        return True

    def _load_keys(self) -> None:
        self._keys = enrolled_peers()

    def review(self, report: StopReport) -> StopReport:
        """Return the report as it is: a peer answers a stop once."""
        return report


def _answer(name: str, reply: dict[str, Any], latency_ms: float, *, claimed: bool) -> Answer:
    result = reply.get("result")
    if reply.get("type") != "response" or not isinstance(result, dict):
        return Answer(name, None, latency_ms, str(reply.get("error", "no answer")))
    stopped, _ = stop_outcome(result)
    why = "" if stopped else explain(result)
    return Answer(name, stopped, latency_ms, why, result, required=claimed, enrolled=claimed)
