"""The commands in docs/how-to/service.md."""

import re
from typing import Final

from tests.fresh_clones import ROOT

_PAGE: Final = (ROOT / "docs/how-to/service.md").read_text()
_AS_ROOT: Final = 'sudo() { "$@"; }; set -e\n'


def commands(heading: str, number: int = 0) -> str:
    """Return the commands of a block below a heading, for a shell that runs as root."""
    [section] = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", _PAGE, re.MULTILINE | re.DOTALL)
    blocks: list[str] = re.findall(r"^```sh\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    return _AS_ROOT + blocks[number]


def exposure() -> tuple[str, str]:
    """Return the exposure level that the page claims, and the version of systemd that it is for."""
    [(figure, version)] = re.findall(r"gives an exposure of (\d\.\d) with systemd (\d+) ", _PAGE)
    return figure, version
