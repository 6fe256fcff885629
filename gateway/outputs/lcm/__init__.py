"""The LCM output: a channel for each topic, the parameters of each source, and replies to requests.

Start with ``output``. ``sender`` publishes: from the event loop on multicast, which does not block, and from
a thread with a bounded queue on tcpq and to files, which do.

- ``connection``: opening LCM, and saying in words why it fails; LCM itself writes that to stderr only.
- ``requests``: requests of peers and their replies, each with an id and the name of who asks. They come on a
  port of their own, so that the gateway does not receive its own messages.
- ``receiver``: receives these requests in a thread. On multicast it does without liblcm, which two damaged
  datagrams can crash.
- ``subscriber``: the other side, for ``echo``, the demo and tests. ``checks``: what the doctor checks.
"""
