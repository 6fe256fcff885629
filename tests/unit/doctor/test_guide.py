import re
from pathlib import Path

from gateway.doctor import gateway_checks, source_checks
from gateway.outputs.registry import OUTPUTS

GUIDE = (Path(__file__).parents[3] / "docs/how-to/troubleshoot.md").read_text(encoding="utf-8")


def test_the_guide_lists_every_check_in_order() -> None:
    table = GUIDE.partition("## What doctor checks")[2].partition("\n## ")[0]
    checks = re.findall(r"^\| [^|]*\| ([\w ]+) \|", table, re.MULTILINE)
    expected = [
        "file",
        *gateway_checks.CHECKS,
        *source_checks.CHECKS,
        *(check for kind in OUTPUTS.values() for check in kind.checks),
        "clock",
    ]
    assert [check for check in checks if check != "check"] == expected
