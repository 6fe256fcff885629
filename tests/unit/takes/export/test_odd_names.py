"""Names of files are bytes for Linux, and need not be UTF-8: old archives have names in Latin-1."""

import os
from pathlib import Path
from typing import Final

import pytest

from gateway.takes.export.job import export_take
from tests.unit.takes.export.test_every_format import NAMES, job_for
from tests.unit.takes.export.test_takes_in_one_file import take_of

ODD: Final = os.fsdecode(b"M\xfcller")


@pytest.mark.parametrize("form", NAMES)
@pytest.mark.parametrize("which", ["take", "out"])
def test_names_that_are_not_utf_8(tmp_path: Path, form: str, which: str) -> None:
    """All that is written in the files is UTF-8, and so are the notes, which are printed."""
    take = take_of(tmp_path / os.fsdecode(b"f\xff"), "a")
    job = job_for(form, take, tmp_path / "new")
    job.details = {"subject": "01"}
    if which == "take":
        job.take = take.rename(take.with_name(f"{ODD}.lcmlog"))
    else:
        job.out = job.out.with_name(f"{ODD}{job.out.suffix}")
    paths = export_take(job)
    assert paths
    for path in paths:
        content = path.read_bytes()
        if path.suffix in {".xml", ".trc", ".mot", ".sto", ".json", ".md", ".tsv", ".csv"}:
            content.decode()
        if form == "opensim" and which == "take":
            os.fsencode(path.name).decode()
