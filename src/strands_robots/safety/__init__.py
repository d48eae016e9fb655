"""Safety plane: permission to stop, lockouts, halts, and their record.

How a robot and its network enter it::

    from strands_robots.safety.plane import plane
    from strands_robots.safety.persistence import hardware_key, simulation_key

    entry = plane().register("arm-1", robot, key=hardware_key("so101", port_id))   # before it can move
    ...
    entry.close()                                                                   # the lockout on disk stays

``robot`` needs ``halt(reason)`` and a ``gate``; registering attaches the robot's lockout to the gate, so that every
``gate.permit`` is refused while it is locked. ``key`` is None for a simulation that was given no peer id.

How an emergency stop enters it, by any path::

    from strands_robots.safety.orders import StopRules

    order = StopRules().order(source_device_id, params, "runtime")     # StopOrder, or a StopRefused that says why
    if isinstance(order, StopOrder):
        reports = await asyncio.to_thread(plane().emergency_stop, order)   # waits for every verdict

    plane().emergency_stop(StopOrder(new_epoch(), "arm-1", "button"))      # this process's own stop

``begin`` is the same without the wait. The same epoch by a second path halts nothing twice. A resume is
``entry.resume(assertion)``; ``plane().lockouts()`` says who is locked; ``plane().checkin.fields(time.monotonic())``
is what ``getStatus`` shows of the dead-man check-in.
"""
