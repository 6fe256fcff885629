"""A client of running gateways, on Zenoh or LCM, for commands and for other programs.

Live data::

    from gateway.client import live

    for frame in live("lab", components=["3d"]):
        print(frame.markers["head"], frame.capture_time)

Everything else that gateways answer::

    from gateway.client import GatewayAddress, GatewayClient, Messages

    with GatewayClient(GatewayAddress(connect="tcp/192.0.2.5:7447")) as client:
        for source in client.sources().sources:
            print(source.name, source.server)
        [parameters] = client.parameters("lab").received
        print(parameters.content.decode())
        client.start_take("walk", source="lab")
        subscriber = client.subscribe(["lab"], ["3d"], Messages(lambda source, key, message: ...))

- ``client`` is the beginning: where gateways are, and everything that can be asked; it also copies takes.
- ``transport`` is what ``zenoh_transport`` and ``lcm_transport`` have in common: they find sources, with what
  gateways report about them, ask until there is a reply, and subscribe.
- A subscriber sorts what arrives by source and key, for a ``reception``, which keeps it in bounds, and counts
  it, and what is missing. ``queued_reception`` keeps messages until they are decoded, for displays and for
  ``live``, whose beginning is ``live_stream``: ``live_frames`` decodes, ``live_join`` joins components.
- With ``complete``, each series has a ``completion``, which decides what to request and when
  (``request_timing``). ``delivery`` hands messages on in their order, and fills gaps with what the history
  has. ``restart_check`` finds out whether the gateway has restarted; ``arrived_run`` is what waits meanwhile,
  and ``publisher_watch`` notices a second gateway. The threads of ``refill`` make the requests
  (``history_requests``), on LCM with ``lcm_refill`` and ``lcm_requester``.
- ``live_arguments`` checks what ``live`` is given. ``recorder`` records what is received as takes.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gateway.client.client import GatewayAddress, GatewayClient
    from gateway.client.live_frames import Frame
    from gateway.client.live_stream import Live, live
    from gateway.client.reception import Messages

__all__ = ["Frame", "GatewayAddress", "GatewayClient", "Live", "Messages", "live"]


def __getattr__(name: str) -> Any:
    """Import the client when it is used: what reads takes does not need Zenoh and LCM."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gateway.client import client, live_frames, live_stream, reception  # noqa: PLC0415 - see above

    modules = (client, live_frames, live_stream, reception)
    return next(getattr(module, name) for module in modules if hasattr(module, name))
