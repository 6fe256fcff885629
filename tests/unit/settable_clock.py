"""A monotonic clock that tests set."""


class SettableClock:
    """Returns ``now_s`` when it is called."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s
