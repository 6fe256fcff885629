"""The doctor: checks every layer between servers and subscribers, and suggests remedies.

``all_checks`` runs the checks in the order in which a fault has consequences, and each gives a ``Finding``
(what was checked, whether it is right, what was found, what to do). It also checks this computer's clock.
``report`` prints the findings, for people or as JSON.

- ``source_checks``: one server, from its name to its frames. It connects as the gateway does and listens for
  some seconds: ``observation`` collects what arrives, ``frame_checks`` judges it.
- ``search``: the servers on hosts that the user names, if their addresses are not known.
- ``exposure``: every port of a configuration, by what the outputs say of their ports and ``reach`` of who can
  reach them.
- The checks of an output are in its own package (``checks``, or ``output``).
"""
