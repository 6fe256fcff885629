"""Counts of the data frames and components that were sent."""

from collections import Counter

from gateway.rtc3d.components import ComponentType


class SentCounts:
    """Counts data frames and the components in them."""

    def __init__(self) -> None:
        self._frames: Counter[tuple[ComponentType, ...]] = Counter()

    def add(self, components: tuple[ComponentType, ...]) -> None:
        """Count one frame with these components."""
        self._frames[components] += 1

    @property
    def frames(self) -> int:
        """The number of frames."""
        return self._frames.total()

    @property
    def components(self) -> Counter[str]:
        """How often each component was in a frame, by its key."""
        counts: Counter[str] = Counter()
        for components, frames in self._frames.items():
            counts.update({component.key: frames for component in components})
        return counts
