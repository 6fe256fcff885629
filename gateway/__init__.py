"""The RTC3D gateway: from motion-capture servers (NDI First Principles, WaveFront) to Zenoh and LCM."""

from importlib.util import find_spec

__version__ = "0.1.0"


def version_text() -> str:
    """Return the version, and whether what every frame goes through is compiled (docs/design.md)."""
    path = find_spec("gateway.publish.fan_out")
    is_plain = path is None or path.origin is None or path.origin.endswith(".py")
    return __version__ if is_plain else f"{__version__} (compiled)"
