"""A robot with two verbs of its own: agents, the page, the command line and Python find and call them.

It counts as real hardware: it moves only for callers that you allow, and only with your approval::

    DEVICE_CONNECT_RPC_ALLOW=strands-robots STRANDS_ROBOT_COMMAND_ALLOW=brewCoffee .venv/bin/python examples/barista.py
    strands-robots call barista brewCoffee cups=2              # in another terminal
"""

import sys
import time
from typing import Annotated, Literal

from strands_robots import Domain, Permit, run, verb


class Barista:
    beans_g = 250.0

    @verb(motion=True, lasts=60.0)
    def brew_coffee(
        self, cups: Annotated[int, Domain(1, 8)], permit: Permit, strength: Literal["mild", "strong"] = "mild"
    ) -> dict[str, object]:
        """Brew coffee, two seconds a cup."""
        ends = time.monotonic() + 2.0 * cups
        while permit.valid and time.monotonic() < ends:  # a stop makes the permit void
            time.sleep(0.02)  # your motor's next step, here
        self.beans_g -= 8.0 * cups
        return {"cups": cups, "strength": strength}

    @verb(motion=False)
    def beans_left(self) -> float:
        """Read how many grams of beans are left."""
        return self.beans_g


if __name__ == "__main__":
    sys.exit(0 if run(Barista(), peer_id="barista").stopped else 1)
