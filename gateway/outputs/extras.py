"""Outputs that need a package which is not always installed."""

from gateway.errors import ConfigError


def missing_package(output: str, extra: str, error: ImportError) -> ConfigError:
    """Return the error for an output that is enabled, but whose package is not installed."""
    package = error.name or extra
    return ConfigError(
        f"{output}.enabled is true, but the package {package!r} is not installed; install it with "
        f"pip install 'rtc3d-gateway[{extra}]', or set {output}.enabled to false"
    )
