"""What people look at: the 3D view, the tables of ``top``, and the live data that both show.

``live`` is the beginning: ``LiveData`` takes the messages that a ``gateway.client`` receives, or those of a
take that is replayed, and decodes the newest ones when somebody looks at them. ``statistics`` has how often
markers and tools were visible, and latencies.

- ``top``: ``facts`` makes values of the live data, for tables and JSON; ``pages`` and ``table`` lay them out;
  ``app`` draws them and takes keys.
- ``view``: a web page with viser, which is imported only there.
- ``terminal``: keys, screens and lists for all commands.

What a gateway says about a source is read in one place for all of them: ``messages.source_report``.
"""
