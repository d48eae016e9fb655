"""The old name of :mod:`strands_robots.mesh.session`."""

import sys

from strands_robots.mesh import session

sys.modules[__name__] = session
