"""The packages that a release installs or contains, and the libraries inside them."""

import json
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution, distributions
from typing import Any, Final

from release.build import run

_COPIED_KEYS: Final = ("type", "name", "version", "scope", "hashes", "licenses", "purl")


def packages_of(python: str) -> list[Distribution]:
    """Return what is installed for a Python, without pip and the gateway."""
    folder = run(python, "-I", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    found = (each for each in distributions(path=[folder]) if each.name not in {"rtc3d-gateway", "pip"})
    return sorted(found, key=lambda package: package.name.lower())


def mypy() -> Distribution:
    """Return mypy, as installed beside this program: its runtime is a part of the compiled modules."""
    return distribution("mypy")


def contents_of(package: Distribution) -> Iterator[dict[str, Any]]:
    """Yield the libraries inside a package as CycloneDX components, if its wheel describes them (PEP 770)."""
    for file in sorted(package.files or (), key=str):
        if file.parent.name == "sboms" and file.suffix == ".json":
            for component in json.loads(file.read_text()).get("components", []):
                if component["name"] != package.name:
                    yield {key: component[key] for key in _COPIED_KEYS if key in component}
