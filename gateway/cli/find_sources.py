"""Finding what gateways serve, for ``list`` and ``echo``, with the options of the command line."""

from gateway.cli.find_lcm import find_on_lcm
from gateway.cli.find_zenoh import find_on_zenoh
from gateway.cli.found_sources import FoundSources
from gateway.errors import OutputError
from gateway.messages.topics import lcm_channel
from gateway.outputs.discovery import missing_source
from gateway.outputs.kind import SubscriptionRequest
from gateway.outputs.lcm import subscriber as lcm
from gateway.outputs.lcm.settings import DEFAULT_LCM_PREFIX, effective_lcm_url
from gateway.outputs.zenoh import subscriber as zenoh
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX


def find_sources(output: str, request: SubscriptionRequest) -> tuple[FoundSources, str]:
    """Return what is found on an output, zenoh or lcm, and why nothing is; "" if something is.

    The component of ``request`` does not matter. Raises OutputError if LCM does not open.
    """
    find = _find_on_lcm if output == "lcm" else _find_on_zenoh
    found, no_gateway = find(request)
    if not found.heard:
        return found, no_gateway
    wanted = () if request.source is None or found.sources else (request.source,)
    return found, missing_source(wanted, found.heard)


def _find_on_zenoh(request: SubscriptionRequest) -> tuple[FoundSources, str]:
    prefix = request.prefix or DEFAULT_ZENOH_PREFIX
    try:
        session = zenoh.open_zenoh(request.address, request.config)
    except OutputError as error:
        return FoundSources(), str(error)
    try:
        return find_on_zenoh(session, prefix, request.source), zenoh.no_gateway(prefix, (), ())
    finally:
        session.close()


def _find_on_lcm(request: SubscriptionRequest) -> tuple[FoundSources, str]:
    prefix, url = request.prefix or DEFAULT_LCM_PREFIX, effective_lcm_url(request.address)
    channels = prefix if request.source is None else lcm_channel(prefix, request.source)
    return find_on_lcm(url, prefix, request.source), lcm.no_gateway(channels, url)
