"""The remote side of the mesh's measurements: an echo, and many peers.

``python -m benchmarks.mesh_children echo PORT`` answers what it hears on ``strands/bench/ask`` and tells when
each input frame arrived; ``fleet PREFIX COUNT`` joins that many peers, ``follow LEADER`` follows one, ``crowd COUNT``
pretends to be that many, ``listen`` hears them, and ``parse`` hears them without a peer.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import threading
import time
from typing import Any

REQUEST = {"sender_id": "console", "turn_id": "0" * 32, "command": {"action": "ping"}, "timestamp": 1700000000.123456}
REPLY = {"type": "response", "responder_id": "echo", "turn_id": "0" * 32, "result": {}, "timestamp": 1700000000.123456}


def raw_config(endpoint: str, *, listen: bool) -> str:
    """A bare session, as plain as ours is not."""
    own: dict[str, Any] = {"scouting": {"multicast": {"enabled": False}}, "namespace": "strands"}
    own |= {"mode": "peer", "listen": {"endpoints": [endpoint]}} if listen else {"mode": "client"}
    return json.dumps(own if listen else {**own, "connect": {"endpoints": [endpoint]}})


def echo(port: str) -> None:
    import zenoh  # noqa: PLC0415 - only this role needs it

    with zenoh.open(zenoh.Config.from_json5(raw_config(f"tcp/127.0.0.1:{port}", listen=False))) as session:

        def answer(sample: Any) -> None:
            json.loads(sample.payload.to_bytes())
            source = zenoh.SourceInfo(session.id, 0)
            session.put("strands/bench/answer", json.dumps(REPLY).encode(), source_info=source)

        arrivals: list[tuple[int, float]] = []

        def arrived(sample: Any) -> None:
            arrivals.append((json.loads(sample.payload.to_bytes())["seq"], time.time()))

        session.declare_subscriber("strands/bench/ask", answer)
        session.declare_subscriber("strands/bench/input/leader", arrived)
        print(json.dumps({"ready": True}), flush=True)
        for _ in sys.stdin:
            print(json.dumps(arrivals), flush=True)
            arrivals.clear()


def fleet(prefix: str, count: str) -> None:
    from fixtures.mesh_robots import Arm  # noqa: PLC0415 - only this role needs it

    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - likewise

    arms = [Arm(f"{prefix}-{number}") for number in range(int(count))]
    meshes = [init_mesh(arm, arm.tool_name_str) for arm in arms]
    print(json.dumps({"ready": all(mesh is not None and mesh.alive for mesh in meshes)}), flush=True)
    for line in sys.stdin:
        if line.strip() == "halted":
            print(json.dumps([arm.halted_at for arm in arms]), flush=True)
        elif line.strip() == "cost":
            print(json.dumps([time.process_time(), threading.active_count()]), flush=True)
        elif line.strip() == "clear":
            # A benchmark stops the same robots many times; an operator at the machine would clear them so.
            from strands_robots.safety.plane import plane  # noqa: PLC0415 - likewise

            plane().clear_local("benchmark")
            for arm in arms:
                arm.halted_at = 0.0
            print(json.dumps(True), flush=True)
    for mesh in meshes:
        if mesh is not None:
            mesh.close()


def follow(source: str) -> None:
    from fixtures.mesh_robots import Arm  # noqa: PLC0415 - only this role needs it

    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - likewise
    from strands_robots.mesh.input import InputReceiver  # noqa: PLC0415 - likewise

    applied: list[tuple[int, float]] = []

    def apply(robot: Any, action: dict[str, float]) -> None:
        applied.append((round(action["n"] * 1000), time.time()))

    arm = Arm("follower")
    mesh = init_mesh(arm, "follower")
    assert mesh is not None
    while mesh.peer_wire_zid(source) is None:
        time.sleep(0.02)
    receiver = InputReceiver(mesh, arm, source, apply_fn=apply)
    receiver.start()
    print(json.dumps({"ready": receiver.running}), flush=True)
    for _ in sys.stdin:
        print(json.dumps([applied, receiver.stats]), flush=True)
        applied.clear()
    mesh.close()


def crowd(count: str) -> None:
    """Publish the presence of many peers, each at 2 Hz, from one session."""
    import zenoh  # noqa: PLC0415 - only this role needs it

    endpoint = f"tcp/127.0.0.1:{os.environ['STRANDS_MESH_PORT']}"
    facts = {"robot_type": "robot", "hostname": "host", "tool_name": "so100", "task_status": "idle", "connected": True}
    over = threading.Event()
    with zenoh.open(zenoh.Config.from_json5(raw_config(endpoint, listen=False))) as session:

        def announce() -> None:
            pause, source = 0.5 / int(count), zenoh.SourceInfo(session.id, 0)
            for turn in itertools.cycle(range(int(count))):
                if over.wait(pause):
                    return
                body = {**facts, "robot_id": f"p{turn}", "timestamp": time.time()}
                session.put(f"strands/p{turn}/presence", json.dumps(body).encode(), source_info=source)

        announcing = threading.Thread(target=announce)
        announcing.start()
        print(json.dumps({"ready": True}), flush=True)
        sys.stdin.read()
        over.set()
        announcing.join()


def listen() -> None:
    """Run a peer that reports its CPU seconds and the number of peers it sees."""
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - only this role needs it

    mesh = init_mesh(None, "listener")
    assert mesh is not None
    print(json.dumps({"ready": mesh.alive}), flush=True)
    for _ in sys.stdin:
        print(json.dumps([time.process_time(), sum(row["reachable"] for row in mesh.peers)]), flush=True)
    mesh.close()


def parse() -> None:
    """Report the same of a bare session that parses the JSON of each heartbeat."""
    import zenoh  # noqa: PLC0415 - only this role needs it

    endpoint, seen = f"tcp/127.0.0.1:{os.environ['STRANDS_MESH_PORT']}", set()
    with zenoh.open(zenoh.Config.from_json5(raw_config(endpoint, listen=True))) as session:

        def parsed(sample: Any) -> None:
            seen.add(json.loads(sample.payload.to_bytes())["robot_id"])

        session.declare_subscriber("strands/*/presence", zenoh.handlers.Callback(parsed, indirect=False))
        print(json.dumps({"ready": True}), flush=True)
        for _ in sys.stdin:
            print(json.dumps([time.process_time(), len(seen)]), flush=True)


ROLES = {"echo": echo, "fleet": fleet, "follow": follow, "crowd": crowd, "listen": listen, "parse": parse}

if __name__ == "__main__":
    ROLES[sys.argv[1]](*sys.argv[2:])
