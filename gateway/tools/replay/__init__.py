"""Replaying a take: its messages on Zenoh and LCM under a prefix of their own, at their pace.

``play_list`` says which messages, and ``timeline`` when. The thread of ``player`` reads them and waits until
each is due, as ``pace`` says, unless ``control`` has another request; ``publication`` publishes it, and
answers queries. ``replay`` is all of this, from its beginning to its end.
"""
