"""The native mesh for the calling side."""
