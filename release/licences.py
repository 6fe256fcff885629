"""Check the licences of the packages of a Python, and write their names and texts into one file.

    build/release-venv/bin/python -m release.licences PYTHON THIRD_PARTY.txt

A licence that is unknown, or that release/licences.toml does not allow, is an error.
"""

import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any, Final

from license_expression import ExpressionError, get_spdx_licensing

from gateway import __version__
from release.build import ROOT, complete_file
from release.packages import contents_of, mypy, packages_of

_TABLE: Final = tomllib.loads((ROOT / "release/licences.toml").read_text())
_SPDX: Final = get_spdx_licensing()
_LICENCE_FILES: Final = ("AUTHORS", "COPYING", "LICENCE", "LICENSE", "NOTICE")
_HEADER: Final = """\
The packages that rtc3d-gateway {version} is distributed with, or installs, and their licences. Each has been
published by its authors and is distributed unchanged. Their sources are at the addresses below. The libraries
inside these packages and their licences are in the bills of materials (*.cdx.json).
"""


def main() -> None:
    """Write the file, or end with the list of all licences that are not allowed."""
    python, output = sys.argv[1:]
    packages = [*packages_of(python), mypy()]
    if problems := [problem for package in packages for problem in problems_of(package)]:
        sys.exit("\n".join([*problems, "See release/licences.toml."]))
    sections = [_HEADER.format(version=__version__), *map(section, packages)]
    with complete_file(Path(output)) as unfinished:
        unfinished.write_text(f"\n{'=' * 80}\n".join(sections))


def licence_of(package: Distribution) -> str | None:
    """Return the SPDX expression of a package's licence, or None if it is unknown."""
    override: str | None = _TABLE["packages"].get(package.name)
    return override or next((text for text in _declared(package) if is_spdx(text)), None)


def _declared(package: Distribution) -> Iterator[str]:
    for field in ("License-Expression", "License"):
        yield from package.metadata.get_all(field) or ()


def is_spdx(text: str) -> bool:
    """Return whether a text is an SPDX expression of known licences."""
    try:
        _SPDX.parse(text, validate=True)
    except ExpressionError:
        return False
    return text.upper() != "UNKNOWN"


def is_allowed(licence: str) -> bool:
    """Return whether licences.toml allows one of the alternatives of an SPDX expression."""
    return _is_true(_SPDX.parse(licence))


def _is_true(expression: Any) -> bool:
    match type(expression).__name__:
        case "AND":
            return all(map(_is_true, expression.args))
        case "OR":
            return any(map(_is_true, expression.args))
        case "LicenseWithExceptionSymbol":  # an exception adds to what its licence permits
            return _is_true(expression.license_symbol)
    return expression.key in _TABLE["allowed"]


def problems_of(package: Distribution) -> Iterator[str]:
    """Yield a sentence for each licence of a package, and of what is inside it, that is not allowed."""
    name = f"{package.name} {package.version}"
    licence = licence_of(package)
    if licence is None:
        yield f"{name}: unknown licence, {[*_declared(package)]}"
    elif not is_allowed(licence):
        yield f"{name}: {licence} is not allowed"
    for component in contents_of(package):
        if component.get("scope", "required") == "required":
            for choice in component.get("licenses", []):
                licence = choice.get("expression") or choice["license"].get("id")
                if licence is None or not is_allowed(licence):
                    yield f"{name} contains {component['name']}: {licence} is not allowed"


def section(package: Distribution) -> str:
    """Return the name, licence, address and licence texts of a package."""
    urls = package.metadata.get_all("Project-URL") or []
    pages = package.metadata.get_all("Home-page") or [url.partition(", ")[2] for url in urls]
    address = pages[0] if pages else ""
    note = " (its runtime is a part of the compiled modules)" if package.name == "mypy" else ""
    texts = [
        f"\n--- {file.name} ---\n\n{Path(str(file.locate())).read_text(encoding='utf-8', errors='replace')}"
        for file in sorted(package.files or (), key=str)
        if file.name.upper().startswith(_LICENCE_FILES) and file.suffix not in {".py", ".pyc"}
    ]
    lines = [f"{package.name} {package.version}{note}", f"Licence: {licence_of(package)}", address]
    return "\n".join([*lines, *(texts or ["\nThe package has no licence text."])])


if __name__ == "__main__":
    main()
