"""An operator makes a key, stops the fleet, is refused a motion, and frees the fleet with the key."""

import os
import sys
import time
from pathlib import Path

from strands_robots.mesh.resume_authority import generate_signing_key, load_signing_key

KEY, PASSPHRASE = Path(sys.argv[1]) / "resume_key.pem", "Correct-Horse-7-Battery"
os.environ["STRANDS_MESH_RESUME_PUBLIC_KEY"] = generate_signing_key(KEY, PASSPHRASE)

from strands_robots import Robot  # noqa: E402 - it reads the key
from strands_robots.mesh import init_mesh  # noqa: E402 - likewise

arm = Robot("so100", mesh=True, peer_id="arm-1")
console = init_mesh(None, peer_id="console")
assert console is not None
deadline = time.time() + 20
while console.get_peer("arm-1") is None and time.time() < deadline:
    time.sleep(0.1)

for answer in console.emergency_stop():
    print("answered:", answer["responder_id"], answer["type"])
print("refused:", console.tell("arm-1", "wave", policy_provider="mock", duration=1.0)["error"])
print("resume:", console.resume(load_signing_key(KEY, PASSPHRASE), targets=["arm-1"]))
while arm.mesh.lockout_epoch is not None and time.time() < deadline + 20:
    time.sleep(0.1)
print("free:", arm.mesh.lockout_epoch is None)
console.stop()
arm.mesh.stop()
