"""``python -m strands_robots.cli``, for processes that start one another.

They need no script on the path.
"""

from strands_robots.cli import main

main()
