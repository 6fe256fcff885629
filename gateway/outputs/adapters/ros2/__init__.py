"""The output for ROS 2: it speaks the wire format of rmw_zenoh, and needs no ROS installation.

Start with ``output``: one node, on the Zenoh router that ROS uses. It opens its session as the output
``zenoh`` does. One thread encodes messages and makes all calls that can wait for a router that does not read.

- ``source``: one source. It takes frames in the event loop and hands those that somebody wants to the thread.
- ``source_topics``: the topics of a source, and which messages a frame becomes.
- ``topic``: a topic as rmw_zenoh has it: its key with the type's hash, its liveliness token, the attachment
  of each message with the publisher's id and number.
- ``latched``: topics whose newest message late subscribers need, as on /tf_static.
- ``diagnostics``: the status of a source as ROS 2 shows it. The messages in CDR are in ``messages.ros2``.
- ``checks``: what the doctor checks.
"""
