"""What is asked of a player while it runs: to pause, to go elsewhere, another rate, to stop."""

import threading

from gateway.tools.replay.pace import PlayerClock


class PlayerControl:
    """Takes requests in any thread; the thread of the player waits for them, and takes them up.

    A seek is relative to ``position_us``, so both change under one lock. ``start_us`` is the earliest place.
    """

    def __init__(self, start_us: int, clock: PlayerClock) -> None:
        self.start_us = start_us
        self._clock = clock
        self._changed = threading.Condition()  # of all that follows
        self.position_us = start_us
        """Where in the take the newest message is."""
        self.is_paused = False
        """Whether the replay pauses; see ``pause``."""
        self.is_at_end = False
        """Whether the player waits at the end."""
        self.is_stopping = False
        """Whether the player is to end soon."""
        self._seek_us: int | None = None
        self._rate: float | None = None  # to be changed to

    def pause(self, is_paused: bool) -> None:
        """Pause, or continue at the same place."""
        with self._changed:
            self.is_paused = is_paused
            self._changed.notify()

    def seek(self, delta_us: int) -> None:
        """Continue at another place, this far from the present one."""
        with self._changed:
            self.seek_to((self.position_us if self._seek_us is None else self._seek_us) + delta_us)

    def seek_to(self, position_us: int) -> None:
        """Continue at a position, in µs from the first message of the take."""
        with self._changed:
            self._seek_us = max(self.start_us, position_us)
            self._changed.notify()

    def set_rate(self, rate: float) -> None:
        """Continue at another rate. The player must have been created with a rate."""
        with self._changed:
            self._rate = rate
            self._changed.notify()

    def stop(self) -> None:
        """End the player's thread soon."""
        with self._changed:
            self.is_stopping = True
            self._changed.notify()

    # In the thread of the player.

    @property
    def must_attend(self) -> bool:
        """Whether something is asked that the player has not taken up, or it pauses."""
        # Without the lock, because the player reads it for each message; what it misses, it sees at the next.
        return self.is_paused or self.is_stopping or self._seek_us is not None or self._rate is not None

    @property
    def _must_leave(self) -> bool:
        return self.is_stopping or self._seek_us is not None

    def wait(self, seconds: float) -> None:
        """Wait for so long, or until something is asked."""
        with self._changed:
            if not self.must_attend:
                self._clock.wait(self._changed, seconds)

    def wait_to_continue(self) -> bool:
        """Wait until the end of a pause; return False if the replay is to stop or to go elsewhere."""
        with self._changed:
            while self.is_paused and not self._must_leave:
                self._clock.wait(self._changed, None)
            return not self._must_leave

    def wait_at_end(self) -> int | None:
        """Wait for a seek, and return its position; None if the replay is to stop."""
        with self._changed:
            self.is_at_end = True
            while not self._must_leave:
                self._clock.wait(self._changed, None)
            self.is_at_end = False
            return None if self.is_stopping else self.take_seek()

    def take_rate(self) -> float | None:
        """Return the rate that is asked for, once; None if none is."""
        with self._changed:
            rate, self._rate = self._rate, None
            return rate

    def take_seek(self) -> int | None:
        """Go to the position that is asked for, and return it; None if none is."""
        with self._changed:
            seek_us, self._seek_us = self._seek_us, None
            if seek_us is not None:
                self.position_us = seek_us
            return seek_us

    def drop_seek(self) -> None:
        """Forget a seek that came with the last message, at the end of a pass."""
        with self._changed:
            self._seek_us = None
