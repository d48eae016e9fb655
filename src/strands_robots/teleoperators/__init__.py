"""Leaders that drive a follower in place of a policy: an arm, a keyboard, a gamepad, a recorded file."""
