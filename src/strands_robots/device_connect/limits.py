"""Deadlines of the bring-up, in seconds."""

BRINGUP_TIMEOUT_S = 20.0
"""In which a device has to be callable and announced; a broker that is starting has time to come up."""

LOOP_JOIN_TIMEOUT_S = 5.0
"""For which a failed or stopped bring-up waits for its thread to end."""

PROBE_TIMEOUT_S = 1.0
"""In which a device that already has the wanted id has to answer."""

PROBES, PROBE_EVERY_S = 3, 0.05
"""How often, and how far apart, a peer asks for its own id before it is nobody's."""

PRESENCE_WAIT_S = 0.25
"""In which a live device has announced itself after a probe, where access rules forbid to call it."""

LEAVE_TIMEOUT_S = 15.0
"""For which a device's end waits for the stop lane's link to close."""
