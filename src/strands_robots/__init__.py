"""Robots on a network where agents find them, drive them and can always stop them."""
