"""Arms from their MJCF: tip poses, joints for a pose, contacts, checked paths."""
