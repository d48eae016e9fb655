"""How the demo ends: an emergency stop that latches, a refusal, an operator's signature, and a motion again."""

from __future__ import annotations

import secrets
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.audit import verify_audit_integrity
from strands_robots.cli.demo.agent import Agent
from strands_robots.cli.demo.show import Show
from strands_robots.cli.demo.story import WATCH_S, Story
from strands_robots.cli.output import Failure, label, plain
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.ed25519 import keygen, load_signing_key
from strands_robots.safety.resume import sign

CONTROLLER = "demo-safety"
DEADLINE_S = 3.0
AGAIN_S = 2.0


@contextmanager
def operator() -> Iterator[Any]:
    """An operator's key, made for this demo, of which the robot's process will know the public half.

    Robot and audit get a state folder for this demo alone, so that no demo finds the lockout of an earlier one.
    """
    with tempfile.TemporaryDirectory(prefix="strands-demo-") as folder:
        key, passphrase = Path(folder) / "operator.pem", f"Demo-{secrets.token_hex(16)}"
        settings.put("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(key, passphrase))
        settings.put("STRANDS_STATE_DIR", folder)
        settings.put("STRANDS_MESH_AUDIT_DIR", "")
        # A controller of the user's own does not take part.
        settings.put("DEVICE_CONNECT_ESTOP_ALLOW", CONTROLLER)
        settings.put("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", "")
        settings.put("STRANDS_CHECKIN_TIMEOUT_S", "0")
        yield load_signing_key(key, passphrase)


class Ending:
    """The last steps.

    Args:
        show: where it is told.
        agent: who drives.
        story: the steps before these.
        peer_id: the robot.
        controller: stops, on a connection of its own.
        key: the operator's.
    """

    def __init__(
        self, show: Show, agent: Agent, story: Story, *, peer_id: str, controller: SafetyController, key: Any
    ) -> None:
        self._show, self._agent, self._story, self._peer = show, agent, story, peer_id
        self._controller, self._key = controller, key
        self._report = story.report
        self._estop_id = ""

    @property
    def steps(self) -> tuple[Callable[[], None], ...]:
        """What happens, in order."""
        return self.emergency_stop, self.refuse, self.resume, self.move_again

    def emergency_stop(self) -> None:
        """A safety controller stops the arm in mid-motion, on a connection that carries nothing else."""
        self._show.head("It moves once more, and a safety controller stops everything")
        with self._report.step("emergency stop") as row, self._agent.events(self._peer) as stream:
            self._story.set_off(stream, "wave on", 1.2)
            told = self._controller.stop([self._peer], "demonstration", deadline_s=DEADLINE_S)
            if not told.ok:
                raise Failure(f"{self._peer} did not answer the emergency stop with a stop: {told}")
            answer = told.stopped[self._peer]
            self._estop_id = row["estop_id"] = told.estop_id
            row["latency_ms"], row["halt_ms"] = round(answer.latency_ms, 2), answer.facts.get("elapsed_ms")
            row["braking_rad"], row["drift_rad"] = self._story.rest(stream)
        self._show.done(
            f"{self._peer} halted {row['halt_ms']} ms after it heard {CONTROLLER}, and answered with its lockout on "
            f"disk in {row['latency_ms']:.1f} ms; {row['drift_rad']:.4f} rad in {WATCH_S:g} s after that"
        )

    def refuse(self) -> None:
        """The next motion is refused, with who stopped the arm and how to resume it."""
        self._show.head("The agent tries to go on")
        with self._report.step("refusal") as row:
            answer = self._agent.ask(self._peer, "execute", instruction="go on", policy_provider="mock", duration=1.0)
            row["reason"] = str(answer.get("reason", ""))
            if answer.get("status") != "error" or self._estop_id not in row["reason"]:
                raise Failure(f"A locked arm did not refuse a motion in the name of its stop: {answer}")
            if CONTROLLER not in row["reason"]:
                raise Failure(f"The refusal does not say who stopped the arm: {row['reason']}")
        self._show.panel(label(plain(row["reason"], 1000), "red"))
        self._show.done("the motion was refused, by name")

    def resume(self) -> None:
        """The operator's signature frees the arm, which stays where it is."""
        self._show.head("The operator signs a resume")
        with self._report.step("resume") as row:
            (assertion,) = sign(self._key, self._estop_id, [self._peer])
            answer = self._agent.call(self._peer, "resume", assertion=assertion)
            status = self._agent.call(self._peer, "getStatus")
            if answer.get("locked") is not False or status.get("locked") is not False:
                raise Failure(f"{self._peer} is still locked after the operator's resume: {answer}")
            if status.get("running_policies"):
                raise Failure(f"A resume started a motion: {status['running_policies']}")
            row["epochs"] = answer.get("epochs")
        self._show.done(f"the key made for this demo freed {self._peer}; nothing moves by it")

    def move_again(self) -> None:
        """A motion that runs to its end, and a safety record that holds together."""
        self._show.head("And the agent drives again")
        with self._report.step("execute again") as row, self._agent.events(self._peer) as stream:
            row["steps"], row["travelled_rad"] = self._story.to_the_end(stream, "wave goodbye", AGAIN_S)
            audit = verify_audit_integrity()
            row["audit_records"] = audit["total"]
            if not audit["ok"] or audit["total"] < 2:
                raise Failure(f"The safety audit does not tell what happened: {audit}")
        self._show.done(
            f"execute ran to its end: {row['steps']} steps; the safety audit holds together: "
            f"{row['audit_records']} records"
        )
