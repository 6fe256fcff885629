"""The Zenoh output: a key for each topic, JSON beside it, parameters and files, and answers to queries.

Start with ``output``: it opens a session (``session``), which Zenoh itself keeps connected from then on, and
gives each topic a ``publisher``, and each source liveliness tokens, a queryable, and publishers of parameters
and files. Messages are put from the event loop, because a put does not block; all that can wait for a peer is
done in threads.

- ``answers``: from a query to its replies, which a thread sends. Too many queries, too large answers and
  peers that do not read are limited here, with ``outputs.query_admission``.
- ``json_publishing``: KEY/json for subscribers that cannot decode LCM's types, made in a thread with a share
  of its time for each source.
- ``config``: Zenoh's own configuration with the gateway's defaults, also for the sessions of commands.
- ``subscriber``: the other side, for ``echo``, the demo and tests. ``checks``: what the doctor checks.

The output ``ros2`` uses ``session`` for its own session. docs/design.md has the measurements behind the
threads and limits.
"""
