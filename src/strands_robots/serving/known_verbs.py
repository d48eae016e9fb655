"""Names of our robots' verbs, for callers that need no more of them.

``tests/serving/test_known_verbs.py`` holds them to those tables. No verb of a robot's own has one of these names.
"""

from __future__ import annotations

READS = frozenset(
    {
        *("describe", "features", "ping", "state", "status", "teleop_status", "teleop_stop"),
        *("getControl", "getDaemonStatus", "getFeatures", "getImu", "getJoints", "getObjects", "getPicture", "getPose"),
        *("getState", "getStatus", "listCameras", "listMoves"),
    }
)
"""Reads that are answered at once."""

STOPS = frozenset({"stop", "stopMotion"})

RESUMES = frozenset({"resume", "renewControl", "releaseControl", "takeControl"})
"""Verbs that free a robot and move nothing."""

QUICK = READS | STOPS | RESUMES
"""Verbs that are answered at once and start no motion."""

WAITING = frozenset({"goTo", "moveBy", "moveJoints", "moveTo", "pick", "place", "setGripper", "wait"})
"""Verbs that may wait for the end of a motion."""

STARTING = frozenset(
    {
        *("acquireControl", "antennas", "body", "disableMotors", "drive", "enableMotors", "execute", "happy", "look"),
        *("navigateTo", "nod", "playMove", "releaseTorque", "reset", "savePlace", "shake", "sleep", "start", "step"),
        *("teleop_receive", "wakeUp"),
    }
)
"""Motions that are only started, and what is asked for as one."""

VERBS = QUICK | WAITING | STARTING

TEXTS = frozenset(
    {
        *("camera", "device_name", "direction", "frame_id", "instruction", "kind", "lease_id", "library", "motor_ids"),
        *("move_name", "nonce", "object", "on", "picture", "place", "policy_host", "policy_provider"),
        *("pretrained_name_or_path", "reason", "robot_name", "source_peer_id", "task_id"),
    }
)
"""Parameters of those verbs that are texts; every other one is none."""
