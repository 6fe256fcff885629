"""Extensions of other packages, which these name as entry points."""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

from gateway.errors import ConfigError
from gateway.runtime.safe_text import safe_text


def add_installed(group: str, noun: str, add: Callable[[EntryPoint], None]) -> dict[str, str]:
    """Call ``add`` with each entry point of a group; return by name why one of them cannot be used.

    ``add`` raises ConfigError if it refuses one, and whatever the module of the package raises. ``noun`` says
    what the entry points are.
    """
    unusable = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: (entry.name, entry.value)):
        try:
            add(entry)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a broken package must not stop the program
            what = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
            unusable[entry.name] = safe_text(
                f"the {noun} {entry.name} of the package {package_of(entry)} cannot be used: "
                f"{' '.join(what.split())}; repair, update or uninstall the package"
            )
    return unusable


def package_of(entry: EntryPoint) -> str:
    """Return the name and the version of the package that has an entry point."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
