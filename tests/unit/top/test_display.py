import pytest
from rich.cells import cell_len

from gateway.terminal.screen import Line
from gateway.top.display import Display
from gateway.top.pages import PAGES
from tests.statuses import stream
from tests.unit.top.live_lab import LiveLab


class Shown:
    """The display of a source with 30 markers, of which the second one is missing."""

    def __init__(self, width: int = 100, height: int = 20) -> None:
        self.display = Display("Zenoh", has_keys=True)
        self.width, self.height = width, height
        lab = LiveLab()
        lab.status(stream("3d"))
        lab.frame("3d", 0, 30, missing=(1,))
        self.sources = [lab.source()]
        self.notices: list[str] = []

    def lines(self) -> list[Line]:
        return self.display.lines(self.sources, self.notices, self.width, self.height)

    def texts(self) -> list[str]:
        return ["".join(text for text, _ in line).rstrip() for line in self.lines()]

    def press(self, *keys: str) -> list[str]:
        self.lines()
        for key in keys:
            self.display.press(key)
        return self.texts()

    def body(self) -> list[str]:
        return [line for line in self.texts()[3:-1] if line]


@pytest.mark.parametrize("size", [(40, 10), (200, 60), (20, 3), (1, 1), (80, 24)])
@pytest.mark.parametrize("number", range(len(PAGES)))
def test_every_page_fills_the_screen_and_no_more(size: tuple[int, int], number: int) -> None:
    shown = Shown(*size)
    shown.notices = ["no gateway found on Zenoh; check that it is running with this prefix"]
    texts = shown.press(str(number + 1))
    assert len(texts) == size[1]
    if size[0] >= 40:
        assert all(cell_len(text) <= size[0] for text in texts)


def test_keys_switch_the_page() -> None:
    shown = Shown()
    assert shown.press("2")[2].startswith("marker")
    assert shown.press("right")[2].startswith("tool")
    assert shown.press("shift-tab", "left")[2].startswith("component")
    assert shown.press("left")[2].startswith("time")
    assert shown.press("tab")[2].startswith("component")
    assert shown.press("9", "0", "x")[2].startswith("component")


def test_keys_scroll_and_stop_at_the_ends() -> None:
    shown = Shown()
    shown.press("2")
    assert shown.body()[0].startswith("marker 2 ")
    assert shown.press("down")[3].startswith("marker 1 ")
    assert shown.press("up", "up")[3].startswith("marker 2 ")
    assert shown.press("page-down")[-1].endswith(" 15–30 of 30")
    assert shown.press("end")[-2].startswith("marker 30 ")
    assert shown.press("down", "page-down")[-2].startswith("marker 30 ")
    assert shown.press("home")[3].startswith("marker 2 ")


def test_keys_sort() -> None:
    shown = Shown()
    shown.press("2")
    assert "visible in 10 s↑" in shown.texts()[2]
    assert "visible in 10 s↓" in shown.press("r")[2]
    assert shown.texts()[3].startswith("marker 1 ")
    while "marker↑" not in shown.press("s")[2]:
        pass
    assert shown.texts()[3].startswith("marker 1 ")
    assert shown.press("r")[3].startswith("marker 30 ")


def test_the_filter_is_typed_and_cleared() -> None:
    shown = Shown()
    shown.press("2", "/", *"MARKER", "space", *"39", "backspace")
    assert shown.texts()[-1] == "filter: MARKER 3"
    assert [line.split()[1] for line in shown.body()] == ["3", "30"]
    assert shown.press("q", "backspace", "enter")[-1].startswith("filter: MARKER 3  Esc clear")
    assert not shown.display.is_over
    shown.press("escape")
    assert len(shown.body()) == 16
    shown.press("/", *"xyz", "ctrl-u", "a", "escape")
    assert len(shown.body()) == 16
    shown.press("/", *"nowhere")
    assert shown.body() == ["nothing here contains 'nowhere'"]


def test_q_ends() -> None:
    shown = Shown()
    shown.press("q")
    assert shown.display.is_over


def test_notices_are_shown_above_the_table_and_escaped() -> None:
    shown = Shown()
    shown.notices = ["lcm: the connection is lost\x1b[2J"]
    assert shown.texts()[2] == r"lcm: the connection is lost\x1b[2J"


def test_without_a_keyboard_no_key_is_named() -> None:
    display = Display("LCM", has_keys=False)
    assert "quit" not in "".join(text for line in display.lines([], [], 100, 20) for text, _ in line)
