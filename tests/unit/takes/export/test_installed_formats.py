"""Export formats of other packages: what works is like the gateway's own, what does not disturbs no other."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.errors import SelectionError, TakeError
from gateway.takes.export.job import ExportJob, export_take
from gateway.takes.export.registry import FORMATS, UNUSABLE, add_installed_formats
from gateway.tools.cli.main import app
from tests.support.errors import names, raises
from tests.support.installed_packages import install_package
from tests.support.takes import details, markers, write_take

Install = Callable[..., None]

WORKING = """
from gateway.takes.export.registry import Format
def write(job):
    [source] = job.open_take(["3d"]).sources.values()
    file = job.files.create(job.file_name())
    file.write(b"".join(b"%d\\n" % number for number in source.markers.frame_number[:WRITTEN]))
    job.rows.written[source.name, "3d"] += len(source.markers.frame_number[:WRITTEN])
WRITTEN = None
FORMAT = Format(write, ("3d",), keeps_details=False, lacks={"3d": "positions"})
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a format; the registry is as before in the end."""
    formats = dict(FORMATS)
    folder = tmp_path / "site-packages"
    monkeypatch.syspath_prepend(str(folder))

    def restore() -> None:
        FORMATS.clear()
        FORMATS.update(formats)
        UNUSABLE.clear()
        add_installed_formats.cache_clear()

    def installing(module: str, name: str = "frames", package: str = "rtc3d_frames") -> None:
        install_package(folder, module, package, "gateway.export_formats", f"{name} = {package}:FORMAT")
        restore()

    yield installing
    restore()


@pytest.fixture
def take(tmp_path: Path) -> Path:
    frames = [markers(1, number, frame_number=100 + number) for number in range(3)]
    return write_take(tmp_path / "walk.lcmlog", [details("Ada"), *frames])


def exported(take: Path, name: str) -> ExportJob:
    job = ExportJob(take, take.with_name(name))
    assert export_take(job) == [job.out]
    return job


def test_an_installed_format_is_written_by_its_extension(install: Install, take: Path) -> None:
    install(WORKING)
    job = exported(take, "Walk.FRAMES")
    assert job.out.read_text() == "100\n101\n102\n"
    assert UNUSABLE == {}


def test_the_table_says_what_it_lacks(install: Install, take: Path) -> None:
    """The formats of this package report what they leave out; so do those of other packages."""
    install(WORKING.replace("WRITTEN = None", "WRITTEN = 2"))
    notes = {note.what: note.amount for note in exported(take, "walk.frames").notes}
    assert notes["left out of lab: subject, positions"] == ""
    assert notes["rows of 3d of lab that are in no file"] == "1 of 3"


def test_several_exports_in_one_process_find_it(install: Install, take: Path) -> None:
    install(WORKING)
    for name in ("a.frames", "b.frames"):
        exported(take, name)
    assert UNUSABLE == {}


def test_an_unknown_extension_is_an_error_that_lists_it(install: Install, take: Path) -> None:
    install(WORKING)
    with raises(SelectionError, "walk.farmes", ".c3d", ".mcap", ".frames"):
        export_take(ExportJob(take, take.with_name("walk.farmes")))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 / 0", ("rtc3d_frames 1.2", "ZeroDivisionError", "rtc3d_frames.py:13")),
        ("raise TakeError('no markers')", ("no markers",)),
        ("raise OSError(28, 'No space left on device')", ("No space left on device",)),
    ],
)
def test_an_installed_format_that_fails_leaves_no_file(
    line: str, reason: tuple[str, ...], install: Install, take: Path
) -> None:
    """A defect names the package, because it is none of the gateway."""
    module = WORKING + f"def fail(job):\n    write(job)\n    {line}\nFORMAT = Format(fail)\n"
    install("from gateway.errors import TakeError\n" + module)
    with pytest.raises(TakeError) as error:
        export_take(ExportJob(take, take.with_name("walk.frames")))
    assert names(str(error.value), *reason)
    assert ("defect" in str(error.value)) == ("rtc3d_frames 1.2" in reason)
    assert {path.name for path in take.parent.iterdir()} == {"site-packages", "walk.lcmlog"}


BROKEN = {
    "cannot be imported": ("import nosuch", "ModuleNotFoundError: No module named 'nosuch'"),
    "ends the program": ("raise SystemExit('no licence')", "SystemExit: no licence"),
    "has no such object": ("", "AttributeError: module 'rtc3d_frames' has no attribute 'FORMAT'"),
    "is of another type": (WORKING + "FORMAT = write", "rtc3d_frames:FORMAT is of the type function"),
}


@pytest.mark.parametrize(("module", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_one_is_an_error_only_for_its_extension(
    module: str, reason: str, install: Install, take: Path
) -> None:
    install(WORKING, "other", "rtc3d_z")
    install(module)
    with pytest.raises(TakeError) as error:
        export_take(ExportJob(take, take.with_name("walk.frames")))
    assert names(str(error.value), "walk.frames", "frames", "rtc3d_frames 1.2", reason, "uninstall")
    assert "\n" not in str(error.value)
    assert not isinstance(error.value, SelectionError)
    for name in ("walk.csv", "walk.other"):
        out = take.with_name(name)
        export_take(ExportJob(take, out))
    assert {path.name for path in take.parent.glob("walk*")} == {
        "walk-3d.csv",
        "walk.lcmlog",
        "walk.other",
    }


@pytest.mark.parametrize("name", ["csv", "two.parts", "CSV", "../up"])
def test_an_extension_that_is_not_free_changes_nothing_else(name: str, install: Install, take: Path) -> None:
    before = dict(FORMATS)
    install(WORKING, name)
    export_take(ExportJob(take, take.with_name("walk.csv")))
    assert (take.parent / "walk-3d.csv").read_text().startswith("time_s,")
    assert before == FORMATS
    assert names(UNUSABLE[f".{name}"], "rtc3d_frames 1.2", repr(name))


def test_of_two_packages_with_one_extension_the_first_is_used(install: Install, take: Path) -> None:
    install(WORKING, package="rtc3d_a")
    install(WORKING, package="rtc3d_b")
    exported(take, "walk.frames")
    assert names(UNUSABLE[".frames"], "rtc3d_b 1.2", "'frames' is taken")


def test_the_command_writes_it_and_names_packages_that_cannot_be_used(install: Install, take: Path) -> None:
    install(WORKING)
    install("import nosuch", "broken", "rtc3d_broken")
    out = take.with_name("walk.frames")
    result = CliRunner().invoke(app, ["export", str(take), str(out)], catch_exceptions=False)
    assert (result.exit_code, result.stdout) == (0, f"{out} (12 bytes)\n")
    assert names(result.stderr, "rtc3d_broken 1.2", "No module named 'nosuch'")


def test_help_and_completion_do_not_import_it(install: Install) -> None:
    """A package may take long to import, and the shell waits."""
    install(WORKING)
    for words in (["--help"], ["export", "--help"]):
        assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
    assert "rtc3d_frames" not in sys.modules
    assert ".frames" not in FORMATS
