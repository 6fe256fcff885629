"""All checks, layer by layer, so that a fault is found before its consequences."""

import asyncio
from collections.abc import AsyncIterator, Iterator

from gateway.config.settings import Settings
from gateway.doctor.clock_check import check_clock
from gateway.doctor.output_checks import check_output
from gateway.doctor.source_checks import CHECKS, SourceChecks
from gateway.errors import ConfigError
from gateway.findings import Finding, MessageLoad, Subject
from gateway.outputs.registry import OUTPUTS

_configuration = Subject("configuration")


async def run_checks(settings: Settings, origin: str, seconds: float) -> AsyncIterator[Finding]:
    """Run all checks, and yield each finding as soon as it is known.

    The sources are watched one after the other, each for ``seconds``.

    ``origin`` says where the settings come from, for example a file name.
    """
    enabled = [name for name, section in settings.outputs.items() if section.enabled]
    names = [source.name for source in settings.sources]
    yield _configuration.passing("file", f"{origin}: {', '.join(names)} to {' and '.join(enabled)}")
    loads: list[MessageLoad] = []
    for source in settings.sources:
        checks = SourceChecks(source, seconds)
        async for finding in checks.run():
            yield finding
        loads += checks.message_loads
    for name, section in settings.outputs.items():
        for finding in await asyncio.to_thread(check_output, OUTPUTS[name], section, names, loads, seconds):
            yield finding
    yield check_clock()


def run_checks_without_settings(error: ConfigError) -> Iterator[Finding]:
    """Yield ``error`` as a finding, and run the checks that need no settings."""
    yield _configuration.failing(
        "file", str(error), "Correct these lines; config/gateway.yaml explains every key."
    )
    subjects = {"source": CHECKS, **{name: kind.checks for name, kind in OUTPUTS.items()}}
    for subject, checks in subjects.items():
        for check in checks:
            yield Subject(subject).not_tested(check, "it needs the configuration, which failed")
    yield check_clock()
