"""The LCM output in the registry."""

from typing import Final

from gateway.outputs.kind import DemoSide, OutputKind, Receive, Subscription
from gateway.outputs.lcm.checks import CHECKS, check_lcm, leaves_host
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber, channel_pattern, subscribe


def _demo(use_network: bool) -> DemoSide:
    """Return LCM for the demo: in memory, or on multicast with ``use_network``."""
    settings = LcmSettings(url=None if use_network else "memq://")
    subscriber_lcm = open_lcm(receiving_url(settings.effective_url))

    def subscribe_here(source: str, receive: Receive) -> Subscription:
        return LcmSubscriber(subscriber_lcm, channel_pattern(settings.prefix, source, None), receive)

    # memq:// connects only users of one LCM object, so the output and the subscriber share it.
    output = LcmOutput(settings, None if use_network else subscriber_lcm)
    return DemoSide(settings, output, subscribe_here)


LCM: Final = OutputKind(
    name=LcmOutput.name,
    settings=LcmSettings,
    create=LcmOutput,
    subscribe=subscribe,
    checks=CHECKS,
    run_checks=check_lcm,
    leaves_host=leaves_host,
    demo=_demo,
)
