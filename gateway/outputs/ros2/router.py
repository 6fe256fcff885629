"""The Zenoh session of the output: a client of the router that the ROS nodes use."""

from collections.abc import Callable
from typing import Final

import zenoh

from gateway.outputs.zenoh.config import zenoh_config
from gateway.outputs.zenoh.session import SessionHolder, SessionTexts

REMEDY: Final = "start it with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or correct ros2.connect"

_WAIT_BEFORE_DROP_US: Final = 70_000_000
"""How long Zenoh waits for a router that does not read, before it drops messages, which it does not count.

Until then, only the sending thread waits, and what finds no place in its queue is counted. This is longer
than the 60 s without a sign of life after which Zenoh gives a connection to rmw_zenohd up.
"""


def client_config(endpoint: str) -> zenoh.Config:
    """Return the configuration of a client of one router, which it does not search by multicast."""
    return zenoh_config(
        {
            "mode": "client",
            "connect": {"endpoints": [endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {
                "link": {
                    "tx": {
                        "queue": {"congestion_control": {"drop": {"wait_before_drop": _WAIT_BEFORE_DROP_US}}}
                    }
                }
            },
        }
    )


def router_session(endpoint: str, declare: Callable[[zenoh.Session], None]) -> SessionHolder:
    """Return the holder of a session with the router at ``endpoint``."""
    texts = SessionTexts(
        "ros2",
        not_open=f"the Zenoh session to {endpoint} is not open yet; if there is no router, {REMEDY}",
        cannot_open=f"no Zenoh router at {endpoint}",
        remedy=REMEDY,
        no_router=f"the Zenoh router at {endpoint} is not connected any more; {REMEDY}",
        opened=f"connected to the router at {endpoint}",
    )
    return SessionHolder(texts, client_config(endpoint), declare)
