"""The mesh's two safety topics: a fleet e-stop and its signed resume, carried to and from the safety plane.

Nothing is decided here. Locking, halting and checking a resume are the plane's, reached through a
:class:`SafetyDoor`; this module translates between it and the wire.
"""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from strands_robots.mesh import dispatch, topics, wire
from strands_robots.mesh.context import Context
from strands_robots.mesh.door import SafetyDoor
from strands_robots.mesh.executor import Lane
from strands_robots.mesh.pursuit import KNOWN_S, Pursuit
from strands_robots.mesh.rpc import Caller, stop_outcome
from strands_robots.mesh.transport import Sample, TransportError
from strands_robots.safety import ed25519
from strands_robots.safety.orders import StopOrder, derived_epoch, new_epoch
from strands_robots.safety.resume import REJECTED, configured_keys, sign
from strands_robots.safety.stopping import Outcome, StopVerdict
from strands_robots.utils import ValidationError, identifier

logger = logging.getLogger(__name__)

COLLECT_S = 3.0
SPACING_S = 0.55
"""Between two messages on a safety topic: peers in the field let two a second through."""

RECENT_MAX = 512


class FleetSafety:
    """Issues and receives fleet e-stops and resumes for one peer.

    Args:
        lane: where a relayed resume is checked, off the transport's thread.
        robot: this peer has one, whose answer to an e-stop comes first.
    """

    def __init__(self, context: Context, door: SafetyDoor, caller: Caller, lane: Lane, *, robot: bool = True) -> None:
        self._context = context
        self._door = door
        self._caller = caller
        self._lane = lane
        self._robot = robot
        self._pursuit = Pursuit(context, caller, f"mesh-{context.peer_id}-pursuit")
        self._recent: deque[str] = deque(maxlen=RECENT_MAX)
        self._admitted: deque[str] = deque(maxlen=RECENT_MAX)
        self._resumed: deque[str] = deque(maxlen=RECENT_MAX)

    def locked(self) -> bool:
        return bool(self._door.epochs())

    # Issuing.

    def emergency_stop(self) -> list[dict[str, Any]]:
        """Stop this robot and every peer; the answer of the robot here, if any, then each attributed reply."""
        context = self._context
        order = StopOrder(new_epoch(), context.peer_id, "emergency stop", "mesh", issued=context.clock())
        # The halt is set going, and the fleet hears of it while the local robot stops.
        local = self._door.begin(order)
        none = {"responses_received": 0, "peers_not_stopped": 0, "peers_silent": 0}
        self._publish_estop(order, none)
        roster = {row["peer_id"] for row in context.registry.all() if row["reachable"]} - {context.peer_id}
        told = time.monotonic()

        def missing(have: list[dict[str, Any]]) -> set[str]:
            nonlocal told
            absent = roster - {str(reply["responder_id"]) for reply in have}
            if absent and time.monotonic() - told >= SPACING_S:
                # A link that was down when the stop was published may be back: the same stop again.
                told = time.monotonic()
                self._publish_estop(order, none)
            return absent

        replies = self._caller.broadcast({"action": "stop"}, COLLECT_S, missing)
        verdict = local() if local is not None else None
        responses = [*self._own(order, verdict), *replies]
        still = {str(each["responder_id"]) for each in responses if stop_outcome(each) is Outcome.STOPPED}
        not_stopped = [name for each in responses if (name := str(each["responder_id"])) not in still]
        silent = sorted(roster - {str(each["responder_id"]) for each in replies})
        for peer in not_stopped:
            logger.critical("%s did NOT stop on emergency stop %s.", peer, order.epoch)
        for peer in silent:
            logger.critical("%s did not answer emergency stop %s.", peer, order.epoch)
        counts = {
            "responses_received": len(responses),
            "peers_not_stopped": len(not_stopped),
            "peers_silent": len(silent),
        }
        self._publish_estop(order, counts)
        self._tell("emergency_stop", order.epoch)
        unreached = (roster | context.registry.heard_within(KNOWN_S)) - still - {context.peer_id}
        self._pursuit.begin(
            order.epoch,
            unreached,
            lambda: order.epoch in self._door.epochs(),
            lambda: self._publish_estop(order, counts),
        )
        context.audit.always(
            "emergency_stop",
            estop_id=order.epoch,
            **counts,
            not_stopped=not_stopped,
            silent=silent,
            lockout_engaged=self.locked(),
        )
        return responses

    def _own(self, order: StopOrder, verdict: StopVerdict | None) -> list[dict[str, Any]]:
        """What the robot here answers, as a peer would; a peer without one has nothing to halt and says nothing."""
        if not self._robot:
            return []
        context = self._context
        told = dispatch.told(verdict or StopVerdict(unknown={context.peer_id: "no answer"}))
        return [wire.Reply("response", context.peer_id, order.epoch, told, timestamp=context.clock()).to_wire()]

    def _publish_estop(self, order: StopOrder, counts: dict[str, Any]) -> None:
        context = self._context
        issued = order.issued if order.issued is not None else context.clock()
        notice = wire.EstopNotice(
            context.peer_id,
            issued,
            order.epoch,
            context.session_id(),
            {**counts, "lockout_engaged": True},
        )
        try:
            context.put(topics.estop(), notice.to_wire())
        except (TransportError, wire.WireError) as exc:
            logger.critical("Emergency stop %s was not published: %s", order.epoch, exc)

    # Receiving.

    def on_estop(self, sample: Sample) -> None:
        """A fleet e-stop arrived: when this returns every robot of this process is locked and its halt under way."""
        received = time.monotonic()
        context = self._context
        try:
            body = wire.decode(sample.payload, topics.BY_NAME["estop"].max_bytes)
            _agree(body, sample)
            notice = wire.EstopNotice.of(body)
        except wire.WireError as exc:
            context.audit("estop_rejected", reason=str(exc))
            return
        if notice.peer_id == context.peer_id and sample.session == context.session_id():
            return
        why = self._door.counts(notice.peer_id)
        if why is not None:
            context.audit("estop_rejected", notice.peer_id, reason=why)
            return
        epoch = notice.estop_id or derived_epoch(notice.peer_id, json.dumps(body["t"]).encode())
        if epoch in self._recent:
            context.audit("remote_estop_redundant", notice.peer_id, estop_id=epoch)
            return
        if sample.retained and epoch in self._resumed:
            context.audit("remote_estop_redundant", notice.peer_id, estop_id=epoch, reason="resumed since")
            return
        order = StopOrder(epoch, notice.peer_id, "fleet e-stop", "mesh", True, notice.t, received)
        self._recent.append(epoch)
        # The plane locks and sets the halts going at once; nothing on this way waits.
        if self._door.begin(order) is None:
            context.audit("remote_estop_redundant", notice.peer_id, estop_id=epoch)
            return
        if order.timing(context.clock()) == "ahead":
            context.audit("estop_clock_skew", notice.peer_id, estop_id=epoch)
        self._tell("emergency_stop", epoch)

    def _tell(self, event: str, epoch: str) -> None:
        """The redacted event for dashboards: what happened, as a code, and nothing of why."""
        context = self._context
        body = {
            "peer_id": context.peer_id,
            "t": context.clock(),
            "event": event,
            "severity": "info",
            "reason": event,
            "estop_id": epoch,
        }
        try:
            context.put(topics.safety_event(context.peer_id), body)
        except (TransportError, wire.WireError) as exc:
            logger.warning("The safety event was not published: %s", exc)

    # Resume.

    def resume(self, signing_key: Any, targets: Sequence[str] | None) -> dict[str, Any]:
        """Sign for every epoch held here, admit it here and relay it to the targets."""
        context = self._context
        wanted = [row["peer_id"] for row in context.registry.all() if row["reachable"]] if targets is None else targets
        epochs = self._door.epochs()
        if not epochs:
            return self._denied("no epoch is held")
        try:
            names = {context.peer_id, *(identifier("target", name) for name in wanted)}
            signed = [each for epoch in epochs for each in sign(signing_key, epoch, names)]
        except (ValidationError, AttributeError, TypeError) as exc:
            return self._denied(str(exc))
        first = True
        for assertion in signed:
            if context.peer_id in assertion["targets"]:
                rejected = self._door.resume(assertion)
                if rejected is not None:
                    return {"status": "error", "error": rejected}
            if not first:
                time.sleep(SPACING_S)
            first = False
            self._relay(assertion)
        return {"status": "ok"}

    def on_resume_command(self, assertion: object) -> dict[str, Any]:
        """A resume that came as a command: admitted and relayed, or the one rejection."""
        rejected = self._door.resume(assertion)
        if rejected is not None:
            return {"status": "error", "error": rejected}
        self._relay(assertion)
        return {"status": "ok"}

    def on_resume(self, sample: Sample) -> None:
        """A relayed resume; one that is not for us costs nothing and is not held against its sender."""
        context = self._context
        try:
            body = wire.decode(sample.payload, topics.BY_NAME["resume"].max_bytes)
            _agree(body, sample)
            relay = wire.ResumeRelay.of(body)
        except wire.WireError as exc:
            context.audit("resume_denied", reason=str(exc))
            return
        if relay.peer_id == context.peer_id and sample.session == context.session_id():
            return
        assertion = relay.assertion
        if sample.retained:
            self._note_resumed(assertion)
            return
        epochs = self._door.epochs()
        if not isinstance(assertion, dict) or not epochs or assertion.get("epoch") not in epochs:
            context.audit("remote_resume_redundant", relay.peer_id)
            return
        targets = assertion.get("targets")
        if not isinstance(targets, list) or context.peer_id not in targets:
            return
        self._lane.submit(lambda: self._apply(relay))

    def _note_resumed(self, assertion: Any) -> None:
        """A resume that the broker kept is too old to clear anything, but says which kept e-stop is over."""
        if not isinstance(assertion, dict) or self._context.peer_id not in (assertion.get("targets") or ()):
            return
        signature = ed25519.decode(assertion.get("sig"), 64)
        try:
            covered = ed25519.canonical({key: value for key, value in assertion.items() if key != "sig"})
        except (ValueError, TypeError, RecursionError):
            return
        if signature is not None and ed25519.signed_by_one_of(configured_keys(), signature, covered):
            self._resumed.append(str(assertion.get("epoch")))

    def _apply(self, relay: wire.ResumeRelay) -> None:
        # The plane records a refusal with its reason; only that it came twice is known here alone.
        nonce = str(relay.assertion.get("nonce"))
        if self._door.resume(relay.assertion) is None:
            self._admitted.append(nonce)
            self._context.audit.always("remote_resume_applied", about=relay.peer_id)
        elif nonce in self._admitted:
            self._context.audit("resume_replay_rejected", relay.peer_id)

    def _relay(self, assertion: Any) -> None:
        context = self._context
        relay = wire.ResumeRelay(context.peer_id, context.clock(), assertion, context.session_id())
        try:
            context.put(topics.resume(), relay.to_wire())
        except (TransportError, wire.WireError) as exc:
            logger.error("A resume was not relayed: %s", exc)  # noqa: TRY400 - one sentence, no trace

    def _denied(self, why: str) -> dict[str, Any]:
        self._context.audit("resume_denied", reason=why)
        return {"status": "error", "error": REJECTED}


def _agree(body: dict[str, Any], sample: Sample) -> None:
    """The session in the body and on the sample: both there and equal, or both absent. Raises WireError."""
    stated = body.get("source_zid")
    if stated is None and sample.session is None:
        return
    if not isinstance(stated, str) or stated != sample.session:
        raise wire.WireError("source_zid and the sample's session disagree")
