"""Leaders that drive a follower in place of a policy."""
