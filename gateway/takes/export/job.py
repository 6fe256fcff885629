"""An export: which part of which take becomes which file, in which format, and what is reported about it.

It imports numpy and what needs it late: the command line imports this module, and numpy is slow to import.
"""

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

from gateway.config.words import join_or
from gateway.errors import SelectionError, TakeError
from gateway.messages.topics import unique_name
from gateway.takes.export.registry import (
    CHOSEN_FORMATS,
    FORMATS,
    UNUSABLE,
    Format,
    add_installed_formats,
)
from gateway.takes.files.new_file import NewFiles

if TYPE_CHECKING:
    from gateway.takes.files.take import Take, TakeSource


_FOLDERS: Final = ("opensim", "bids")
"""Those whose files are in a folder, ``out``."""

_NOUNS: Final = {
    "3d": "markers",
    "6d": "tools (6D)",
    "analog": "analog channels",
    "force": "forces",
    "event": "events",
}
"""What the components are called in notes."""

_WITH_COORDINATES: Final = frozenset({"3d", "6d", "force"})

_MAX_NAMED: Final = 10

_NOT_IN_NAMES: Final = re.compile(r"[/\x00-\x1f\x7f-\x9f]")
"""What names of files do not get: slashes and control characters."""


def export_take(job: "ExportJob") -> list[Path]:
    """Write the files of a job, and return their names. Raises TakeError; then none of them exists."""
    add_installed_formats()
    extension = job.out.suffix.lower()
    if job.format == "ros2" and extension != ".mcap":
        raise SelectionError(f"{job.out} does not end in .mcap, as a bag of ROS 2 does; add .mcap")
    if job.format in _FOLDERS and extension in FORMATS:
        raise SelectionError(
            f"--{job.format} writes a folder, and {job.out} is the name of a file; omit {extension}"
        )
    if not job.format and extension not in FORMATS:
        if extension in UNUSABLE:
            raise TakeError(f"{job.out} cannot be written: {UNUSABLE[extension]}")
        raise SelectionError(
            f"{job.out} has no known extension; choose {join_or(FORMATS)}, "
            "or --opensim or --bids for a folder"
        )
    with job.files:
        job.chosen_format.write(job)
        job.note_rows()
        job.progress(f"saving {job.out.name}", 0, 0)
    return job.files.paths


class Note(NamedTuple):
    """What was changed, rounded or left out in a file, and how much of it; ``file`` is "" for all files."""

    file: str
    what: str
    amount: str


Axis: TypeAlias = Literal["x", "y", "z", "-x", "-y", "-z"]


@dataclass(frozen=True)
class TakePart:
    """What is exported of a take: ``source`` is the name of one source, None all.

    ``from_s`` and ``to_s`` are in seconds from the first event of the take; None is its beginning or its end.
    """

    source: str | None = None
    from_s: float | None = None
    to_s: float | None = None

    @property
    def is_limited(self) -> bool:
        """Whether the time is limited."""
        return self.from_s is not None or self.to_s is not None


class RowCounts:
    """How many rows are to be written and were written, by the name of the source and the component."""

    def __init__(self) -> None:
        self.recorded: Counter[tuple[str, str]] = Counter()
        """How many rows the take has that could be in a file."""
        self.written: Counter[tuple[str, str]] = Counter()
        """How many of them are in files."""

    def differences(self) -> Iterator[tuple[str, str]]:
        """Yield what differs, and how much of it, as in a Note."""
        for (source, key), num_recorded in self.recorded.items():
            num_written = self.written[source, key]
            if num_written < num_recorded:
                missing = f"{num_recorded - num_written} of {num_recorded}"
                yield f"rows of {key} of {source} that are in no file", missing
            elif num_written > num_recorded:
                yield f"rows of {key} of {source} in several files", str(num_written - num_recorded)


@dataclass(frozen=True)
class OpenSimOptions:
    """How files for OpenSim are made.

    ``up`` and ``forward`` are the axes of the server that become Y and X; None means the default, which
    ``axes.rotation_of`` describes. ``min_force_n`` is the force on a plate below which there is no contact;
    None means 10 N. ``bodies`` are the bodies of the model to which the plates' forces are applied, in the
    order of the plates; () means a guess.
    """

    up: Axis | None = None
    forward: Axis | None = None
    min_force_n: float | None = None
    bodies: tuple[str, ...] = ()

    @property
    def has_axes(self) -> bool:
        """Whether the axes are chosen."""
        return self.up is not None or self.forward is not None


@dataclass(frozen=True)
class BidsNames:
    """What the files of a BIDS data set are called after, beside the subject and the session of the take.

    A data set needs a task; ``run`` is that of the first measurement, None the next number.
    """

    task: str | None = None
    run: int | None = None


@dataclass
class ExportJob:
    """What to export, and where it goes.

    ``format`` is a key of CHOSEN_FORMATS; "" means that the extension of ``out`` says the format.
    ``details`` replace those of the take, by name: subject, session, note. ``progress`` is called with what
    is being done, how much of it is done, and how much there is (0: that is not known). ``notes`` say what
    was changed, rounded or left out.
    """

    take: Path
    out: Path
    format: str = ""
    part: TakePart = TakePart()
    details: Mapping[str, str] = field(default_factory=dict)
    progress: Callable[[str, int, int], None] = lambda *_: None
    notes: list[Note] = field(default_factory=list)
    opensim: OpenSimOptions = OpenSimOptions()
    bids: BidsNames = BidsNames()
    files: NewFiles = field(default_factory=NewFiles)
    stems: set[str] = field(default_factory=set)
    """The names of files so far, without extensions."""
    rows: RowCounts = field(default_factory=RowCounts)

    @property
    def chosen_format(self) -> Format:
        """The format of the files. Raises KeyError if the extension of ``out`` is none of FORMATS."""
        return CHOSEN_FORMATS[self.format] if self.format else FORMATS[self.out.suffix.lower()]

    def note(self, what: str, file: str = "", amount: object = "") -> None:
        """Report what was changed, rounded or left out, and how much of it; the same is reported once.

        ``file`` is the name of the file that it concerns; "" means all.
        """
        note = Note(file, what, str(amount))
        if note not in self.notes:
            self.notes.append(note)

    def open_take(self, components: Collection[str]) -> "Take":
        """Return the chosen part of the take, and report what could not be read or has no place.

        ``components`` are the keys of those to load. Raises TakeError.
        """
        from gateway.takes.files.take import open_take  # noqa: PLC0415 - see above

        take = open_take(
            self.take,
            sources=None if self.part.source is None else [self.part.source],
            components=components,
            from_s=self.part.from_s,
            to_s=self.part.to_s,
            progress=lambda done, total: self.progress(f"reading {self.take.name}", done, total),
            spool_folder=self.out.parent,
        )
        for source in take.sources.values():
            if source.is_cut_off:
                self.note(f"INCOMPLETE: the recording of {source.name} was cut off, so its end is missing")
            if source.num_lost:
                self.note(
                    f"INCOMPLETE: messages of {source.name} that its recorder lost", amount=source.num_lost
                )
        if take.num_recordings > 1:
            self.note(
                "several takes in one file: rows are in the order of time, and each occurs once",
                amount=take.num_recordings,
            )
        if take.num_damaged:
            places = "1 place" if take.num_damaged == 1 else f"{take.num_damaged} places"
            self.note(f"the take is damaged at {places}", amount=f"{take.damaged_bytes} bytes")
        if take.unknown:
            more = ["…"] if len(take.unknown) > _MAX_NAMED else []
            channels = ", ".join([*take.unknown][:_MAX_NAMED] + more)
            self.note(
                f"messages of other programs or versions left out, on the channels {channels}",
                amount=sum(take.unknown.values()),
            )
        for source in take.sources.values():
            source.details = source.details._replace(**self.details)
            if not source.parameters:
                self.note(
                    f"no parameters of {source.name} in the take: labels, units and rates are not known"
                )
        self.note_malformed(take)
        self._note_left_out(take)
        self._note_frames(take)
        self._count_all(take)
        if components:
            self.progress(f"arranging the frames of {self.take.name}", 0, 0)
        return take

    def _count_all(self, take: "Take") -> None:
        """Count the rows of the components that are loaded; a row without items has nothing to write."""
        for source in take.sources.values():
            for key, series in source.series.items():
                if series.labels or key == "event":
                    self.count_recorded(source.name, key, len(series.without_empty_frames()))

    def count_recorded(self, source: str, key: str, num_rows: int) -> None:
        """Count rows of a component that the take has, if the format has the component."""
        if key in self.chosen_format.components:
            self.rows.recorded[source, key] += num_rows

    def note_rows(self) -> None:
        """Report if the files have fewer or more rows than the take, whatever the reason."""
        for what, amount in self.rows.differences():
            self.note(what, amount=amount)

    def _note_left_out(self, take: "Take") -> None:
        """Report what a take has and the format has no place for."""
        chosen = self.chosen_format
        for source in take.sources.values():
            recorded = source.recorded | {"", *(["parameters"] if source.parameters else [])}
            components = source.recorded.difference(chosen.components)
            left_out = [noun for key, noun in _NOUNS.items() if key in components]
            if not chosen.keeps_details:
                left_out += [name for name, text in source.details._asdict().items() if text]
            left_out += [what for key, what in chosen.lacks.items() if key in recorded]
            if left_out:
                self.note(f"left out of {source.name}: {', '.join(left_out)}")

    def _note_frames(self, take: "Take") -> None:
        with_coordinates = _WITH_COORDINATES.intersection(self.chosen_format.components)
        for source in take.sources.values():
            if source.recorded & with_coordinates:
                self.note_frame(source)

    def note_frame(self, source: "TakeSource") -> None:
        """Report in which frame coordinates are; all formats but ``ros2`` have those of the server."""
        from gateway.takes.export.source_frame import frame_note  # noqa: PLC0415 - it imports numpy

        note = "" if self.format == "ros2" else frame_note(source)
        if note:
            self.note(note)

    def note_malformed(self, take: "Take") -> None:
        """Report messages that could not be read."""
        for source in take.sources.values():
            for key, count in source.malformed.items():
                if count:
                    self.note(f"malformed messages of {key} of {source.name} left out", amount=count)

    def file_name(self, *parts: str) -> Path:
        """Return the name of a further file: the name of ``out`` with these parts at its end.

        Each has another name, also if those of sources differ only in what a file cannot have, or if a source
        is called like the measurement of another one. This is reported.
        """
        wanted = "-".join([self.out.stem, *(_NOT_IN_NAMES.sub("_", part) for part in parts if part)])
        stem = unique_name(wanted, self.stems, len(wanted) + 10)
        path = self.out.with_name(stem + self.out.suffix)
        if stem != wanted:
            self.note(f"this is {'-'.join(filter(None, parts))}: another file has that name", path.name)
        self.stems.add(stem)
        return path


def nothing_to_export(job: ExportJob, what: str) -> TakeError:
    """Return the error for a take without data that the format can hold."""
    limits = " between --from and --to" if job.part.is_limited else ""
    source = "" if job.part.source is None else f" of {job.part.source}"
    error = SelectionError if limits else TakeError
    return error(
        f"{job.take} has no {what}{source}{limits}, and {_format_name(job)} holds nothing else; "
        "`rtc3d-gateway take info` lists what the take has"
    )


def _format_name(job: ExportJob) -> str:
    return f"--{job.format}" if job.format else job.out.suffix
