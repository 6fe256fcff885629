"""What is the same in all formats: files, sources, parts, and takes without anything to export."""

from pathlib import Path

import pytest

from gateway.errors import TakeError
from gateway.export.extensions import EXTENSIONS
from gateway.export.formats import FORMATS
from gateway.rtc3d.components import ComponentType
from tests.takes import description, frame, markers
from tests.unit.export.exported import export_messages, labelled

ANALOG = frame(ComponentType.ANALOG, [1, 2])
EVENT = frame(ComponentType.EVENT, [(1, 2, -1, -1, -1)])


def test_every_extension_has_a_format() -> None:
    """The command line lists what the module of formats, which is slow to import, can do."""
    assert tuple(FORMATS) == EXTENSIONS


@pytest.mark.parametrize("end", [".c3d", ".trc", "-3d.csv"])
def test_each_source_is_a_file_unless_one_is_chosen(tmp_path: Path, end: str) -> None:
    extension = end.removeprefix("-3d")
    messages = [description("left"), description("right")]
    messages += [markers(2, number, source=source) for number in range(5) for source in ("left", "right")]
    job = export_messages(tmp_path, messages, f"walk{extension}")
    assert [path.name for path in job.files.paths] == [f"walk-left{end}", f"walk-right{end}"]
    job = export_messages(tmp_path, messages, f"one{extension}", source="right")
    assert [path.name for path in job.files.paths] == [f"one{end}"]


@pytest.mark.parametrize(
    ("extension", "messages", "options", "problem"),
    [
        (".c3d", [EVENT], {}, r"has no markers, analog channels or forces, and \.c3d holds nothing"),
        (".trc", [ANALOG], {}, r"take\.lcmlog has no markers, and \.trc holds nothing else"),
        (".trc", [markers(1)], {"from_s": 5.0}, "has no markers between --from and --to"),
        (".csv", [description(), labelled("a")], {}, "has no frames"),
        (
            ".csv",
            [description(), markers(1)],
            {"source": "studio"},
            "no source 'studio'; its sources are: lab",
        ),
        (".mcap", [description(), labelled("a")], {}, "has no frames"),
        (".mcap", [description(), labelled("a")], {"from_s": 0.0, "to_s": 1.0}, "has no frames"),
    ],
)
def test_a_take_without_anything_to_export_is_an_error(
    tmp_path: Path, extension: str, messages: list[tuple[str, bytes]], options: dict[str, float], problem: str
) -> None:
    with pytest.raises(TakeError, match=problem):
        export_messages(tmp_path, messages, f"walk{extension}", **options)
    assert [path.name for path in tmp_path.iterdir()] == ["take.lcmlog"]
