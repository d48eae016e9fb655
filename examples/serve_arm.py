"""Serve a simulated SO-100 on this machine until Ctrl-C, which stops the arm first.

The command line does the same: ``strands-robots serve so100 --peer-id so100-lab-1``.
"""

from __future__ import annotations

import logging
import sys

from strands_robots.robot import Robot


def main() -> int:
    logging.basicConfig(format="%(message)s")
    logging.getLogger("strands_robots").setLevel(logging.INFO)
    arm = Robot("so100", peer_id="so100-lab-1")
    verdict = arm.run()
    arm.cleanup()
    return 0 if verdict.stopped else 1


if __name__ == "__main__":
    sys.exit(main())
