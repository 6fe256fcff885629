"""The newest parameters of a source, as the message that the files of its takes begin with."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Final

from gateway.messages.host_time import now_utime
from gateway.outputs.contract import ServerParameters, encode_parameters, published_again
from gateway.runtime.workers import WorkerThread

_LONG_XML_BYTES: Final = 32 * 1024
"""Longer parameters are encoded by a thread: 16 MB take 30 ms."""


class NewestParameters:
    """Encodes the parameters of a source, and has them recorded in the order in which they were published.

    ``record`` records a message in all files, and returns False if one of them had no room for it.
    ``encoder`` encodes long parameters.
    """

    def __init__(self, encoder: WorkerThread, record: Callable[[bytes], bool]) -> None:
        self.message: bytes | None = None
        """The newest parameters_t; None before the first."""
        self._record = record
        self._encoder = encoder
        self._num_published = 0
        self._encoding: Future[bytes] | None = None  # of the newest long parameters, until they are encoded
        self._is_missing = False  # in a file

    def publish(self, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Record parameters; returns a future if they have to be encoded before what follows them."""
        utime, sequence = now_utime(), self._num_published
        self._num_published += 1
        encode = partial(encode_parameters, parameters, utime=utime, arrived_utime=utime, sequence=sequence)
        # Short ones must not overtake long ones that are still being encoded.
        if self._encoding is None and len(parameters.xml) <= _LONG_XML_BYTES:
            self._record_message(encode())
            return None
        self._encoding = encoding = self._encoder.submit(encode)
        return asyncio.ensure_future(self._record_when_encoded(encoding))

    async def _record_when_encoded(self, encoding: Future[bytes]) -> None:
        message = await asyncio.wrap_future(encoding)
        if self._encoding is encoding:
            self._encoding = None
        self._record_message(published_again(message, now_utime()))

    def _record_message(self, message: bytes) -> None:
        self.message = message
        self._is_missing = not self._record(message)

    def maintain(self) -> None:
        """Record parameters that did not fit into the queue. Called once a second."""
        if self._is_missing and self.message is not None:
            self._record_message(self.message)
