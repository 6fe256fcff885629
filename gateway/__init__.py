"""A gateway from RTC3D motion-capture servers (NDI First Principles, WaveFront) to Zenoh and LCM."""

from importlib.util import find_spec

__version__ = "1.0.0"


def version_text() -> str:
    """Return the version, and whether the modules of the data path are compiled (docs/design.md)."""
    path = find_spec("gateway.publish.fan_out")
    is_python = path is None or path.origin is None or path.origin.endswith(".py")
    return f"{__version__} ({'pure Python' if is_python else 'compiled'})"
