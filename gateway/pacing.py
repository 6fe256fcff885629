"""STUB by the lead, to keep the tree importable: helper 8 replaces this file whole."""


class Pacer:
    def __init__(self, max_rate_hz: float) -> None:
        pass

    def due(self, timestamp_us: int, utime: int) -> bool:
        return True
