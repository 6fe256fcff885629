"""What a program needs to run for months: threads, a log that stays short, limits, and an orderly end.

- ``workers``: threads and processes for what takes long.
- ``failures``, ``losses``: what is logged once, counted meanwhile, and logged again when it ends.
  ``log_format`` has the formats of the log, and ``safe_text`` cuts and escapes text from networks.
- ``quantities``: sizes, durations, rates and counts as text.
- ``token_bucket``: a limit of a rate. ``server_limits``: what the clients of a server may use up.
- ``entry_points``: what other packages add, and why one of them cannot be used.
- ``process_end``: the signals and the end of a command. ``program_end``: the end of other people's programs
  that use this package, and their forks.
"""
