"""The RTC3D protocol, both sides, without I/O: bytes in, objects out, and the reverse.

From the bytes upwards:

- ``packets`` (§4.1): a size, a type, and a body. It finds packets in a stream of bytes, no
  longer than ``max_packet_bytes`` and ``max_c3d_bytes`` of a source allow.
- ``frames`` (§7.1) and ``components`` (§7.3 to §7.7): what data packets contain, as views of the bytes
  received, and what counts as missing. Nothing is converted unless somebody asks for numpy arrays.
- ``commands`` (§5): what a client sends, as typed objects.
- ``parameters`` (§6): what a server says about itself, and the table of its elements and attributes in XML.
  ``parameters_xml`` reads and writes them.
- ``client_protocol``: one connection as a client sees it, with its states. ``reply_matcher`` finds out which
  command a reply answers, because replies do not say so. The server's side is in ``gateway.session.server``.

Be strict in what is sent and liberal in what is accepted: docs/design.md lists what real servers do. Sizes
and counts from the network are checked here, before anything is allocated or read by them.
"""
