"""One pipeline for a command, whichever network it came by.

A network hands what it received to the robot's :class:`~.pipeline.Pipeline`, which checks the arguments, asks once
whether the command may begin, calls the robot's method and answers. :mod:`.verbs` says what a verb is;
:mod:`.robot_verbs` and :mod:`.reachy_verbs` describe every verb once and name the robot method that carries it out.
"""
