"""Robots on the mesh: presence and state as they come, lockouts by question."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from strands_robots.dashboard.feed import ASK_S, MESH, PARALLEL, poll_interval
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.verb_forms import peer_forms
from strands_robots.device_connect.telemetry import numbers
from strands_robots.envelope import Envelope, error, is_error
from strands_robots.fleet.joint_features import joint_limits, joint_units
from strands_robots.fleet.mesh.controller import MeshController
from strands_robots.fleet.mesh.lockouts import ask_peers, lockable_peers, resume_peers
from strands_robots.fleet.mesh.standing import stand_on_mesh
from strands_robots.mesh import Mesh
from strands_robots.safety.stopping import explain, grade

LOOK_S = 0.25
STOP_S = 2.0
LOAD_MAX = 1000.0


class MeshFeed:
    """Robots of the native mesh, and the mesh's own emergency stop.

    Args:
        model: takes what they say.
        mesh: a joined peer without a robot.
        signing_key: signs emergency stops.
    """

    network = MESH

    def __init__(self, model: FleetModel, mesh: Mesh, signing_key: Any = None) -> None:
        self._model, self._mesh = model, mesh
        self.controller = MeshController(mesh, signing_key)
        self._standing = stand_on_mesh(mesh, signing_key, lambda: model.expected(self.network))
        self._forms = peer_forms()
        self._names: set[str] = set()
        self._closing = threading.Event()
        self._calls = ThreadPoolExecutor(PARALLEL, "dashboard-mesh")
        # A stop waits for no other call.
        self._stops = ThreadPoolExecutor(PARALLEL, "dashboard-mesh-stop")
        mesh.subscribe("strands/*/state", self._take_state, "dashboard state")
        # An idle robot's states are further apart than its heartbeats.
        mesh.subscribe("strands/*/presence", self._take_presence, "dashboard presence")
        mesh.subscribe("strands/*/health", self._take_health, "dashboard load")
        mesh.subscribe("strands/*/safety/event", self._take_event, "dashboard events")
        self._thread = threading.Thread(target=self._look, name="dashboard-mesh", daemon=True)
        self._thread.start()

    async def call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        """Call a verb; every failure is an answer of status error."""
        command = {**_given(params), "action": _ON_MESH.get(verb, verb)}
        loop = asyncio.get_running_loop()
        reply = await loop.run_in_executor(self._calls, self._mesh.send, robot, command, seconds)
        return _result(robot, reply)

    async def stop(self, robot: str) -> Envelope:
        """End a robot's motion without a lockout; graded, never raises."""
        loop = asyncio.get_running_loop()
        reply = await loop.run_in_executor(self._stops, self._mesh.send, robot, {"action": "stop"}, STOP_S)
        result = reply.get("result")
        outcome = grade(result)
        if outcome.stopped is True:
            return {"status": "success", "content": [{"text": "Stopped."}], "stopped": True}
        known = reply.get("type") == "response"
        return error(explain(result) if known else "no answer", stopped=outcome.stopped if known else None)

    async def look_closer(self, robot: str) -> None:
        """Read the limits and the cameras of a robot."""
        features, cameras = await asyncio.gather(
            self.call(robot, "features", {}, 3.0), self.call(robot, "listCameras", {}, 3.0)
        )
        found = cameras.get("cameras")
        names = tuple(str(each)[:128] for each in found[:32]) if isinstance(found, list) else ()
        limits = joint_limits(features) if not is_error(features) else {}
        self._model.update(self.network, robot, cameras=names, limits=limits, units=joint_units(features))

    def resume(self, robots: list[str], signer: Any, seconds: float) -> dict[str, tuple[bool, str]]:
        """Free robots with the operator's key; blocks, and returns each outcome."""
        return resume_peers(self._mesh, ask_peers(self._mesh, robots, seconds), signer, seconds)

    def close(self) -> None:
        """Leave the network."""
        self._closing.set()
        self._standing.close()
        self._thread.join(2 * ASK_S + 1.0)
        for pool in (self._calls, self._stops):
            pool.shutdown(wait=False, cancel_futures=True)

    def _look(self) -> None:
        asked = 0.0
        while not self._closing.wait(LOOK_S):
            robots = set(lockable_peers(self._mesh))
            for row in self._mesh.peers:
                if row["peer_id"] in robots:
                    self._meet(row)
            now = time.monotonic()
            if robots and now - asked >= poll_interval(len(robots)):
                asked = now
                for report in ask_peers(self._mesh, sorted(robots), ASK_S):
                    if report.facts:
                        self._model.sign_of_life(self.network, report.name, report.round_trip_ms)
                    self._model.report(self.network, report)

    def _meet(self, row: Mapping[str, Any]) -> None:
        name = str(row["peer_id"])
        self._names.add(name)
        self._model.update(
            self.network,
            name,
            kind=str(row.get("type", ""))[:80],
            model=str(row.get("tool_name", ""))[:80],
            forms=self._forms,
            expected=True,
        )
        state, instruction = str(row.get("task_status", "idle")), str(row.get("instruction", ""))
        self._model.task(self.network, name, state=state, instruction=instruction)

    def _take_state(self, key: str, message: Mapping[str, Any]) -> None:
        name = str(message.get("peer_id", ""))
        if name not in self._names or key.split("/")[-2:] != [name, "state"]:
            return
        self._model.sign_of_life(self.network, name)
        joints = message.get("joints")
        if isinstance(joints, Mapping):
            self._model.observe(self.network, name, numbers(joints))

    def _take_presence(self, key: str, message: Mapping[str, Any]) -> None:
        name = key.split("/")[-2]
        if name in self._names and message.get("robot_id") == name:
            self._model.sign_of_life(self.network, name)

    def _take_health(self, key: str, message: Mapping[str, Any]) -> None:
        name, load = key.split("/")[-2], numbers(message).get("cpu_load")
        if name in self._names and load is not None and 0 <= load < LOAD_MAX:
            self._model.load(self.network, name, load)

    def _take_event(self, key: str, message: Mapping[str, Any]) -> None:
        name = key.split("/")[-3]
        if name in self._names:
            event = str(message.get("event", message.get("type", "safety event")))
            self._model.note(self.network, name, event, message)


_ON_MESH = {"getStatus": "status", "getFeatures": "features", "getState": "state"}


def _given(params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments that were given: the mesh leaves out the others."""
    return {name: value for name, value in params.items() if value not in ("", None)}


def _result(robot: str, reply: Mapping[str, Any]) -> Envelope:
    if reply.get("status") == "timeout":
        return error(f"{robot} did not answer.")
    if reply.get("type") != "response":
        return error(f"{robot}: {reply.get('error', 'refused')}")
    result = reply.get("result")
    return dict(result) if isinstance(result, Mapping) else error(f"{robot} answered with an unknown result shape.")
