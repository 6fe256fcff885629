"""The keys of ``top``: what each does, and how the help page and the last line of the screen name it."""

from collections.abc import Mapping
from enum import Enum, auto
from typing import Final, NamedTuple, TypeAlias

from rich.cells import cell_len

from gateway.tools.display.terminal import Line, Style
from gateway.tools.display.top.pages import PAGES
from gateway.tools.display.top.table import LaidOut, wrapped

_FAR: Final = 1 << 30
"""More lines than any page has."""

_GAP: Final = 2
_MIN_MEANING: Final = 10
"""How many columns the meanings of keys have at least, however narrow the screen is."""


class Do(Enum):
    """What keys do; with a number that says which page, in which direction, and how far."""

    OPEN_PAGE = auto()
    TURN_PAGE = auto()
    SCROLL_LINES = auto()
    SCROLL_SCREENS = auto()
    SORT = auto()
    REVERSE = auto()
    FILTER = auto()
    CLEAR_FILTER = auto()
    HELP = auto()
    QUIT = auto()


Action: TypeAlias = tuple[Do, int]


class TopKey(NamedTuple):
    """Some keys, as they are ``shown`` to the user, and what they do.

    ``short`` is what the last line of the screen says, if anything: keys, and a word.
    ``actions`` are by the names of keys. The system or the screen acts on those without.
    """

    shown: str
    meaning: str
    short: tuple[str, str] | None
    actions: Mapping[str, Action]


_NUMBERS: Final = {str(number): (Do.OPEN_PAGE, number - 1) for number in range(1, len(PAGES) + 1)}
_BEFORE: Final = (Do.TURN_PAGE, -1)
_NEXT: Final = (Do.TURN_PAGE, 1)
_UP: Final = (Do.SCROLL_LINES, -1)
_DOWN: Final = (Do.SCROLL_LINES, 1)
_SCREEN_UP: Final = (Do.SCROLL_SCREENS, -1)
_SCREEN_DOWN: Final = (Do.SCROLL_SCREENS, 1)
_FIRST: Final = (Do.SCROLL_LINES, -_FAR)
_LAST: Final = (Do.SCROLL_LINES, _FAR)

CLEAR: Final = TopKey("Esc", "clear the filter", ("Esc", "clear"), {"escape": (Do.CLEAR_FILTER, 0)})
"""The key that the last line names only while there is a filter."""

KEYS: Final = (
    TopKey("q, Ctrl-C", "quit", ("q", "quit"), {"q": (Do.QUIT, 0), "Q": (Do.QUIT, 0)}),
    TopKey("?", "show what the keys do; any key returns", ("?", "help"), {"?": (Do.HELP, 0)}),
    TopKey(f"1 to {len(PAGES)}", "the page with this number", (f"1-{len(PAGES)} ←→", "page"), _NUMBERS),
    TopKey(
        "← →, h l, Shift-Tab, Tab",
        "the page before, the next page",
        None,
        {"left": _BEFORE, "right": _NEXT, "h": _BEFORE, "l": _NEXT, "shift-tab": _BEFORE, "tab": _NEXT},
    ),
    TopKey(
        "↑ ↓, k j",
        "scroll by a line",
        ("↑↓", "scroll"),
        {"up": _UP, "down": _DOWN, "k": _UP, "j": _DOWN},
    ),
    TopKey(
        "Page Up, Page Down, Space",
        "scroll by a screen",
        None,
        {"page-up": _SCREEN_UP, "page-down": _SCREEN_DOWN, "space": _SCREEN_DOWN},
    ),
    TopKey(
        "Home, End, g G",
        "scroll to the first and to the last line",
        None,
        {"home": _FIRST, "end": _LAST, "g": _FIRST, "G": _LAST},
    ),
    TopKey("s", "sort by the next column", ("s", "sort"), {"s": (Do.SORT, 0)}),
    TopKey("r", "reverse the order", ("r", "reverse"), {"r": (Do.REVERSE, 0)}),
    TopKey(
        "/",
        "show only rows with the text that follows; Enter keeps it, Esc clears it",
        ("/", "filter"),
        {"/": (Do.FILTER, 0)},
    ),
    CLEAR,
    TopKey("Ctrl-Z", "stop until fg, with the terminal as it was", None, {}),
    TopKey("Ctrl-L", "draw everything again", None, {}),
)
"""All keys, in the order in which they are shown."""

ACTIONS: Final = {name: action for key in KEYS for name, action in key.actions.items()}
"""What to do, by the names of keys."""


def short_keys(*, is_filtered: bool) -> list[tuple[str, Style]]:
    """Return what the last line of the screen says about the keys."""
    keys = [key.short for key in KEYS if key is not CLEAR]
    if is_filtered:
        keys.insert(0, CLEAR.short)
    parts: list[tuple[str, Style]] = []
    for name, meaning in filter(None, keys):
        parts += [(f"{name} ", Style.STRONG), (f"{meaning}  ", Style.FAINT)]
    return parts


def help_page(width: int) -> LaidOut:
    """Return the page that says what each key does, in ``width`` columns if they are not too few."""
    indent = max(cell_len(key.shown) for key in KEYS) + _GAP
    body: list[Line] = []
    for key in KEYS:
        shown = key.shown + " " * (indent - cell_len(key.shown))
        for text in wrapped(key.meaning, max(width - indent, _MIN_MEANING)):
            body.append([(shown, Style.STRONG), (text, Style.PLAIN)])
            shown = " " * indent
    return LaidOut([("key".ljust(indent), Style.STRONG), ("what it does", Style.STRONG)], body)
