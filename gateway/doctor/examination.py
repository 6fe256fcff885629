"""The whole examination, in the order in which a fault at one layer hides those at the next."""

import asyncio
from collections.abc import AsyncIterator, Iterator

from gateway.config.settings import Settings
from gateway.doctor import host_checks, source_checks, zenoh_checks
from gateway.doctor.finding import Finding, Patient
from gateway.doctor.observation import ComponentSeen
from gateway.errors import ConfigError

_configuration = Patient("configuration")


async def examine(settings: Settings, origin: str, seconds: float) -> AsyncIterator[Finding]:
    """Yield the findings as they are made; each source is watched for ``seconds``, one after the other.

    ``origin`` says where the settings are from.
    """
    sides = [name for name, on in (("Zenoh", settings.zenoh.enabled), ("LCM", settings.lcm.enabled)) if on]
    names = [source.name for source in settings.sources]
    yield _configuration.good("file", f"{origin}: {', '.join(names)} to {' and '.join(sides)}")
    seen: list[ComponentSeen] = []
    for source in settings.sources:
        examination = source_checks.SourceExamination(source, seconds)
        async for finding in examination.findings():
            yield finding
        seen += [component for watch in examination.watches for component in watch.seen.values()]
    for finding in await asyncio.to_thread(zenoh_checks.examine_zenoh, settings.zenoh, names, seconds):
        yield finding
    for finding in host_checks.examine_lcm(settings.lcm, seen):
        yield finding
    yield host_checks.examine_clock()


def without_settings(error: ConfigError) -> Iterator[Finding]:
    """Yield what can be found without settings, which ``error`` keeps from being made."""
    yield _configuration.bad(
        "file", str(error), "Correct these lines; config/gateway.yaml explains every key."
    )
    for subject, checks in (
        ("source", source_checks.CHECKS),
        ("zenoh", zenoh_checks.CHECKS),
        ("lcm", host_checks.LCM_CHECKS),
    ):
        for check in checks:
            yield Patient(subject).untested(check, "it needs the configuration, which failed")
    yield host_checks.examine_clock()
