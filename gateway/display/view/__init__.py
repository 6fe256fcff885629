"""A live 3D view in the browser; viser is imported only in this package.

``viewer`` is the loop: about 30 times a second it takes the newest data of all sources
(``gateway.display.live``) and updates what the browsers show. With a take instead of a gateway, it also has
the controls of the player.

- ``server``: the web server, and who may connect to it.
- ``scene``: the picture, a group for each source. ``laboratory`` has the floor, the axes, the camera and the
  force plates, ``markers_and_tools`` what moves in it.
- ``panel``: what stands beside the picture: the banner, the tabs, the switches. ``source_text`` says what is
  known about a source, ``texts`` turns numbers and names from the network into HTML, and ``plots`` draws
  channels.

Everything that browsers receive passes through viser, which sends it to all of them. So each object is sent
again only if it has changed.
"""
