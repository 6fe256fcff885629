"""Remote questions about a source, answered from caches where possible; never on the path of the data.

A question reaches ``service`` from an output, which has already checked the peer's rate
(``outputs.query_admission``). It takes one question in a turn of the event loop, finds the source that it
concerns, and returns an answer, a command for the server, or an error for the peer.

- ``questions``: what is asked, parsed from keys and options.
- ``answers``: answers that need no server, and one answer of a server. What takes long to make is made by the
  thread that sends it, once for all peers.
- ``parameter_cache``: the server's parameters: reads them at each connection and again later, publishes
  changes under a new version, and serves peers in the meantime.
- ``server_requests``: when the server is asked for its parameters again, and commands on behalf of peers: one
  at a time, shared where equal; also starting and stopping its recordings.
"""
