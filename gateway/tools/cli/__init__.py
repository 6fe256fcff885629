"""The command line: one module per command or a few, and the modules that print their results.

``main`` has the table of commands and imports the module of a command only when it is needed: help and
completion must be quick. The module of a command therefore imports what it needs to do its work within the
function; ``options`` has the options that several commands share.

- Running: ``run`` (also ``simulate`` and ``demo``, with ``demo_lab``), ``config`` (also ``doctor``).
- Listening: ``list_gateways``, ``echo``, ``top``, ``view``, ``params``.
- Takes: ``record``, ``replay``, ``take`` (also ``export``). ``take_report`` prints which there are, and what
  is in one.

Everything that is asked of running gateways goes through ``gateway.client``.

Modules named after a command (``echo_output``, ``record_progress``, ``replay_run``) do its work.
The exit statuses are in docs/reference/commands.md.
"""
