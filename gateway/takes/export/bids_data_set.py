"""The data set of a BIDS export: its folders, the names of its files, and the tables that grow.

The specification is version 1.11 (https://bids-specification.readthedocs.io). Each export adds files. It
replaces none but participants.tsv and scans.tsv, which get further rows.
"""

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from gateway import __version__
from gateway.errors import SelectionError, TakeError
from gateway.messages.descriptions.labels import printable
from gateway.takes.export.job import ExportJob
from gateway.takes.files.take import Take

_VERSION: Final = "1.11.1"
_DESCRIPTION: Final = "dataset_description.json"
_PARTICIPANTS: Final = "participants.tsv"
_NO_LABEL: Final = re.compile(r"[^0-9A-Za-z]+")
_RUN: Final = re.compile(r"_run-(\d+)_")
NOT_AVAILABLE: Final = "n/a"

_README: Final = """\
# {name}

This data set has motion-capture recordings as Motion-BIDS, version {version} (https://bids.neuroimaging.io).
rtc3d-gateway {program} exported them.

Please say here what was recorded and how, and complete `dataset_description.json` (authors, licence) and
`participants.tsv`.
"""


def bids_label(text: str) -> str:
    """Return the letters and digits of a text, which are all that BIDS has in the labels of file names."""
    return _NO_LABEL.sub("", text)


class DataSet(NamedTuple):
    """The part of a data set that one export writes to. The labels have no prefix; ``session`` can be ""."""

    root: Path
    subject: str
    session: str
    task: str

    @property
    def prefix(self) -> str:
        """The beginning of the names of all files, such as "sub-01_ses-2"."""
        return "_".join(self._folders)

    @property
    def folder(self) -> Path:
        """The folder that has the table of the recordings."""
        return self.root.joinpath(*self._folders)

    @property
    def _folders(self) -> tuple[str, ...]:
        return (f"sub-{self.subject}", *([f"ses-{self.session}"] if self.session else []))

    def path(self, tracking_system: str, run: int, suffix: str) -> Path:
        """Return the path of a file of one recording; ``suffix`` is such as "motion.tsv"."""
        name = f"{self.prefix}_task-{self.task}_tracksys-{tracking_system}_run-{run}_{suffix}"
        return self.folder / "motion" / name

    def next_run(self) -> int:
        """Return the number of the next run of this subject, session and task, from 1 on."""
        files = (self.folder / "motion").glob(f"{self.prefix}_task-{self.task}_*")
        return 1 + max((int(found[1]) for file in files if (found := _RUN.search(file.name))), default=0)


def open_data_set(job: ExportJob, take: Take) -> DataSet:
    """Create or extend the data set: its folders, its description and its participants.

    No other export can write to it until the job ends. Raises TakeError.
    """
    details = [source.details for source in take.sources.values()]
    data_set = DataSet(
        job.out,
        subject=_label(job, "subject", {each.subject for each in details}, is_required=True),
        session=_label(job, "session", {each.session for each in details}),
        task=_label(job, "task", {job.bids.task or ""}, is_required=True),
    )
    folder = job.out
    job.files.create_folder(folder)
    job.files.lock_folder(folder)  # before it is looked at: another export may be creating it
    if any(folder.iterdir()) and not (folder / _DESCRIPTION).exists():
        raise SelectionError(
            f"{job.out} has files, but no {_DESCRIPTION}, so it is no BIDS data set; choose a new folder"
        )
    for part in (data_set.folder / "motion").relative_to(job.out).parts:
        folder /= part
        job.files.create_folder(folder)
    add_rows(job, job.out / _PARTICIPANTS, "participant_id", [{"participant_id": f"sub-{data_set.subject}"}])
    if not (job.out / _DESCRIPTION).exists():
        _describe(job)
    return data_set


def _label(job: ExportJob, name: str, texts: set[str], *, is_required: bool = False) -> str:
    """Return the only one of the texts as a label; "" if there is none. Raises SelectionError."""
    texts = texts - {""}
    if len(texts) > 1:
        both = " and ".join(sorted(texts)[:2])
        raise SelectionError(f"the sources of {job.take} have different {name}s, {both}; choose by --{name}")
    text = next(iter(texts), "")
    label = bids_label(text)
    if text and not label:
        raise SelectionError(
            f"the {name} {text!r} has no letter from A to Z and no digit, as BIDS needs; choose by --{name}"
        )
    if is_required and not label:
        raise SelectionError(f"{job.take} does not say the {name}, and BIDS needs it; add --{name}")
    note_label(job, name, text, label)
    return label


def note_label(job: ExportJob, what: str, text: str, label: str) -> None:
    """Report that something is called by a label that is not its name, if so."""
    if label != text:
        job.note(f"the {what} {text!r} is called {label!r}: BIDS has letters and digits only")


def _describe(job: ExportJob) -> None:
    """Write what belongs to the whole data set."""
    name = printable(job.out.resolve().name)  # which need not be UTF-8
    description = {
        "Name": name,
        "BIDSVersion": _VERSION,
        "DatasetType": "raw",
        "GeneratedBy": [{"Name": "rtc3d-gateway", "Version": __version__}],
    }
    write_json(job, job.out / _DESCRIPTION, description)
    readme = _README.format(name=name, version=_VERSION, program=__version__)
    job.files.create(job.out / "README.md").write(readme.encode())


def write_json(job: ExportJob, path: Path, content: dict[str, Any]) -> None:
    """Write a new JSON file."""
    job.files.create(path).write((json.dumps(content, indent=2, ensure_ascii=False) + "\n").encode())


def write_table(job: ExportJob, path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a new table (.tsv) with a header."""
    job.files.create(path).write("".join(map(_line, (columns, *rows))).encode())


def _line(cells: Iterable[object]) -> str:
    return "\t".join(str(cell) or NOT_AVAILABLE for cell in cells) + "\n"


def add_rows(job: ExportJob, path: Path, key: str, rows: Sequence[dict[str, str]]) -> None:
    """Add rows to a table, unless it has rows with the same ``key``; create it if it does not exist.

    Columns of others get n/a. Raises TakeError if one of ours is missing.
    """
    if not path.exists():
        write_table(job, path, [*rows[0]], [[*row.values()] for row in rows])
        return
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise TakeError(f"{path} is not in UTF-8, as BIDS wants it; correct or remove it") from None
    lines = [line.split("\t") for line in text.split("\n") if line]
    columns = lines[0] if lines else []
    missing = rows[0].keys() - set(columns)
    if missing:
        raise TakeError(f"{path} has no column {min(missing)!r}; add it, or remove the file")
    place = columns.index(key)
    known = {cells[place] for cells in lines[1:] if len(cells) > place}
    new = [row for row in rows if row[key] not in known]
    if new:
        added = [[row.get(column, NOT_AVAILABLE) for column in columns] for row in new]
        end = "" if text.endswith("\n") else "\n"
        job.files.replace(path).write((text + end + "".join(map(_line, added))).encode())
