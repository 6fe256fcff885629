"""Calls from threads into an event loop."""

import asyncio
import threading
from collections.abc import Callable

from gateway.outputs.event_loop import in_this_loop


async def test_a_call_of_another_thread_is_made_in_the_loop() -> None:
    made: asyncio.Future[tuple[int, threading.Thread]] = asyncio.get_running_loop().create_future()
    call = in_this_loop(lambda number: made.set_result((number, threading.current_thread())))
    await asyncio.to_thread(call, 7)
    assert await made == (7, threading.current_thread())


def test_calls_after_the_end_of_the_loop_do_nothing() -> None:
    made: list[None] = []

    async def begin() -> Callable[[], None]:
        return in_this_loop(lambda: made.append(None))

    call = asyncio.run(begin())
    call()
    assert made == []
