"""All checks, ordered so that a fault in one layer comes before the faults that it causes in others."""

import asyncio
from collections.abc import AsyncIterator, Iterator

from gateway.config.settings import Settings
from gateway.doctor import lcm_checks, source_checks, zenoh_checks
from gateway.doctor.clock_check import check_clock
from gateway.errors import ConfigError
from gateway.findings import Finding, MessageLoad, Subject

_configuration = Subject("configuration")


async def run_checks(settings: Settings, origin: str, seconds: float) -> AsyncIterator[Finding]:
    """Yield each finding as soon as it is made. Watches one source after the other, for ``seconds`` each.

    ``origin`` says where the settings come from, for example a file name.
    """
    sides = [name for name, on in (("Zenoh", settings.zenoh.enabled), ("LCM", settings.lcm.enabled)) if on]
    names = [source.name for source in settings.sources]
    yield _configuration.passing("file", f"{origin}: {', '.join(names)} to {' and '.join(sides)}")
    loads: list[MessageLoad] = []
    for source in settings.sources:
        checks = source_checks.SourceChecks(source, seconds)
        async for finding in checks.run():
            yield finding
        loads += checks.message_loads
    for finding in await asyncio.to_thread(zenoh_checks.check_zenoh, settings.zenoh, names, seconds):
        yield finding
    for finding in lcm_checks.check_lcm(settings.lcm, loads):
        yield finding
    yield check_clock()


def run_checks_without_settings(error: ConfigError) -> Iterator[Finding]:
    """Yield the findings that are possible although ``error`` prevents loading the settings."""
    yield _configuration.failing(
        "file", str(error), "Correct these lines; config/gateway.yaml explains every key."
    )
    for subject, checks in (
        ("source", source_checks.CHECKS),
        ("zenoh", zenoh_checks.CHECKS),
        ("lcm", lcm_checks.CHECKS),
    ):
        for check in checks:
            yield Subject(subject).not_tested(check, "it needs the configuration, which failed")
    yield check_clock()
