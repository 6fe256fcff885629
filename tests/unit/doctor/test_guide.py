import re
from pathlib import Path

from gateway.doctor import host_checks, source_checks, zenoh_checks

GUIDE = (Path(__file__).parents[3] / "docs/how-to/troubleshoot.md").read_text(encoding="utf-8")


def test_the_guide_has_every_check_in_its_order() -> None:
    table = GUIDE.partition("## What is looked at")[2].partition("\n## ")[0]
    checks = re.findall(r"^\| [^|]*\| (\w+) \|", table, re.MULTILINE)
    listed = ["file", *source_checks.CHECKS, *zenoh_checks.CHECKS, *host_checks.LCM_CHECKS, "clock"]
    assert [check for check in checks if check != "check"] == listed
