"""The outputs: one contract for all, and a package for each, those for other protocols in ``adapters``.

Start with ``contract``: an ``Output`` opens (``start``), gives a ``Publisher`` for each topic, reports its
health and closes. Everything else that an output can do has a default that does nothing. The tests in
tests/contract/ hold every output to it, and ``guard`` keeps an output that breaks it from hurting the others.

``registry`` lists the outputs. Each has a package with the same modules:

- ``settings``: its section of the configuration, and its entry in the registry, unless that is in ``kind``.
  Every command imports the settings, so they do not import the output itself.
- ``output``: the class that the contract describes, and often its publishers.
- ``checks``: what the doctor checks; with few checks, they are in ``output``.

What several outputs need is here: ``frame_output`` has what outputs of whole frames and servers have in
common, with a thread that has an event loop of its own (``gateway.runtime.workers`` has one for calls that
may block), ``query_admission`` limits the questions of peers, ``listen_address`` says who can connect to a
server, and ``pacing`` leaves out frames. ``findings`` are results of checks, ``open_ports`` says what peers
can do at a port, and ``other_gateways`` notices a second gateway with the same source.

Calls of the contract come from the gateway's event loop and must not block there. An output that may wait for
a network or a disk does so in a thread, behind a queue with a limit, and counts what it drops.
"""
