"""What docs/how-to/service.md has people type."""

import re
from typing import Final

from tests.clones import ROOT

_PAGE: Final = (ROOT / "docs/how-to/service.md").read_text()
_AS_ROOT: Final = 'sudo() { "$@"; }; set -e\n'


def typed(heading: str, number: int = 0) -> str:
    """Return the commands below a heading, for a shell of root: those of its first block, or of another."""
    [section] = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", _PAGE, re.MULTILINE | re.DOTALL)
    blocks: list[str] = re.findall(r"^```sh\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    return _AS_ROOT + blocks[number]


def exposure() -> tuple[str, str]:
    """Return the figure of systemd-analyze security, and the version of systemd that it is of."""
    [(figure, version)] = re.findall(r"gives an exposure of (\d\.\d) with systemd (\d+) ", _PAGE)
    return figure, version
