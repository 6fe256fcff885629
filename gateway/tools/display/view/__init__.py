"""A live 3D view in the browser; viser is imported only in this package.

``viewer`` has the web server, and the loop: about 30 times a second it takes the newest data of all sources
(``gateway.tools.display.live``) and updates what the browsers show. With a take instead of a gateway, it also
has the controls of the player.

- ``scene``: the picture: the floor, the axes and the camera, and a group for each source, of ``scene_items``:
  markers, tools and force plates. ``links`` draws lines between markers that ``segments`` finds to belong to
  one body segment.
- ``panel``: what stands beside the picture: the banner, the tabs, the switches. ``texts`` says what is known
  about a source, as HTML, and ``plots`` draws channels.

Everything that browsers receive passes through viser, which sends it to all of them. So each object is sent
again only if it has changed.
"""
