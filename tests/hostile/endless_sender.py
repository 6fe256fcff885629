"""A client that sends without end, for attacks on the ports of outputs."""

import asyncio
import contextlib


async def send_endlessly(port: int, begin: bytes, repeated: bytes, *, reads: bool = True) -> None:
    """Send ``begin``, then ``repeated`` without end; connect again if the connection ends."""
    while True:
        with contextlib.suppress(OSError):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            reading = asyncio.create_task(_discard(reader) if reads else asyncio.Event().wait())
            try:
                writer.write(begin)
                while not reading.done():
                    writer.write(repeated)
                    await writer.drain()
            finally:
                reading.cancel()
                writer.close()
        await asyncio.sleep(0.01)


async def _discard(reader: asyncio.StreamReader) -> None:
    with contextlib.suppress(OSError):
        while await reader.read(65536):
            pass
