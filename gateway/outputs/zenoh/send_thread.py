"""A thread for what may block in Zenoh, which the end of the program does not wait for."""

import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future


class SendThread:
    """Makes calls one after the other in a thread of its own.

    Not concurrent.futures' ThreadPoolExecutor, because Python waits for its threads at exit: a peer that
    has stopped reading would hold up the end of the gateway for 5 s.
    """

    def __init__(self, name: str) -> None:
        self._work: queue.SimpleQueue[tuple[Future[None], Callable[[], None]] | None] = queue.SimpleQueue()
        self._closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, call: Callable[[], None]) -> Future[None]:
        """Have ``call`` made when its turn comes; the future ends as the call does."""
        done: Future[None] = Future()
        self._work.put((done, call))
        return done

    def close(self) -> None:
        """Make no more calls than the one that is being made."""
        self._closed = True
        self._work.put(None)

    def _run(self) -> None:
        while (work := self._work.get()) is not None and not self._closed:
            done, call = work
            del work  # or the call, and what it holds on to, would stay until the next one comes
            with contextlib.suppress(CancelledError):
                if done.set_running_or_notify_cancel():
                    try:
                        call()
                    except BaseException as error:  # noqa: BLE001 - whoever waits for the future gets it
                        done.set_exception(error)
                    else:
                        done.set_result(None)
            del done, call
