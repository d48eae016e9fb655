"""Speed, measured here and now: every figure is a ratio against the bare part in the same run."""
