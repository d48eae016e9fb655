"""Device Connect for the calling side."""
