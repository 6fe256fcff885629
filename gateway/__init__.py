"""A gateway from RTC3D motion-capture servers (NDI First Principles, WaveFront) to Zenoh and LCM."""

__version__ = "1.0.0"


def version_text() -> str:
    """Return the version, and whether the modules of the data path are compiled (docs/design.md)."""
    from importlib.util import find_spec  # noqa: PLC0415 - see gateway.__main__

    path = find_spec("gateway.publish.fan_out")
    is_python = path is None or path.origin is None or path.origin.endswith(".py")
    return f"{__version__} ({'pure Python' if is_python else 'compiled'})"
