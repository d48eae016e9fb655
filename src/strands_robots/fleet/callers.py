"""Names under which programs of ours call robots."""

SOURCE = "strands-robots"
"""Name of the command line and of ``connect()``, where none is given."""

TOOL = "robot-mesh-tool"
"""Name of the agent's tool and of commands on the mesh; an allowlist of a robot must include it."""
