"""Colours that are readable on a white and on a black background."""

from typing import Final, NamedTuple

Rgb = tuple[int, int, int]

GREY: Final[Rgb] = (128, 128, 128)
"""What is not live."""


class SourceColor(NamedTuple):
    """The colour of a source."""

    rgb: Rgb

    @property
    def faint(self) -> Rgb:
        """The colour of what was there until now."""
        red, green, blue = ((value + 3 * grey) // 4 for value, grey in zip(self.rgb, GREY, strict=True))
        return (red, green, blue)


_COLORS: Final = (
    SourceColor((34, 139, 230)),
    SourceColor((240, 125, 20)),
    SourceColor((55, 165, 70)),
    SourceColor((150, 90, 220)),
    SourceColor((225, 60, 60)),
    SourceColor((150, 100, 60)),
)


def color_of(number: int) -> SourceColor:
    """Return the colour of the source with this number."""
    return _COLORS[number % len(_COLORS)]
