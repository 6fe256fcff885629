"""Closing a Zenoh session, which can take long: in a thread, and waiting only for a while."""

import logging
import threading
from typing import Final

import zenoh

from gateway.outputs.zenoh.config import zenoh_reason

_CLOSE_S: Final = 0.5

logger = logging.getLogger(__name__)


def close_session(session: zenoh.Session, output: str) -> None:
    """Close the session of an output; return when it is closed, or after _CLOSE_S."""
    closer = threading.Thread(target=_close, args=(session, output), name=f"{output}-close", daemon=True)
    closer.start()
    closer.join(_CLOSE_S)


def _close(session: zenoh.Session, output: str) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        logger.debug("%s: closing the session: %s", output, zenoh_reason(error))
