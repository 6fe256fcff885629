"""A thread for calls that may block in Zenoh. The program does not wait for it when it ends."""

import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future


class SendThread:
    """Makes calls one after the other in its own thread.

    A concurrent.futures.ThreadPoolExecutor does not fit: Python waits for its threads at exit, so a peer that
    has stopped reading would delay the end of the gateway by 5 s.
    """

    def __init__(self, name: str) -> None:
        self._work: queue.SimpleQueue[tuple[Future[None], Callable[[], None]] | None] = queue.SimpleQueue()
        self._closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, call: Callable[[], None]) -> Future[None]:
        """Queue ``call``; the returned future has its result or exception."""
        done: Future[None] = Future()
        self._work.put((done, call))
        return done

    def close(self) -> None:
        """Make no further calls; a call in progress continues."""
        self._closed = True
        self._work.put(None)

    def _run(self) -> None:
        while (work := self._work.get()) is not None and not self._closed:
            done, call = work
            del work  # or it would keep the call and its data alive until the next one
            with contextlib.suppress(CancelledError):
                if done.set_running_or_notify_cancel():
                    try:
                        call()
                    except BaseException as error:  # noqa: BLE001 - whoever waits for the future gets it
                        done.set_exception(error)
                    else:
                        done.set_result(None)
            del done, call
