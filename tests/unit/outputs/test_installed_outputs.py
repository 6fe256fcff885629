"""Outputs of other packages: what works is like the gateway's own, what does not concerns only its users."""

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.config import loading
from gateway.config.loading import schema_text, shown_configuration
from gateway.config.settings import Settings
from gateway.errors import ConfigError
from gateway.outputs.findings import Result
from gateway.outputs.registry import OUTPUTS, UNUSABLE, add_installed_outputs, build_outputs, settings_type
from gateway.tools.doctor.all_checks import run_checks
from tests.support.errors import names, raises
from tests.support.example_output import ExampleOutput, ExampleSettings
from tests.support.installed_packages import install_package
from tests.support.records import logged

Install = Callable[..., None]

WORKING = """
from dataclasses import replace
from gateway.config.settings import OutputSettings
from tests.support.example_output import EXAMPLE
KIND = EXAMPLE
"""

OFF = {"lcm": {"enabled": False}, "metrics": {"enabled": False}}


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install an output; the registry is as before in the end."""
    outputs, unusable = dict(OUTPUTS), dict(UNUSABLE)
    folder = tmp_path / "site-packages"
    monkeypatch.syspath_prepend(str(folder))

    def restore() -> None:
        OUTPUTS.clear()
        OUTPUTS.update(outputs)
        UNUSABLE.clear()
        UNUSABLE.update(unusable)

    def installing(module: str, name: str = "example", package: str = "rtc3d_other") -> None:
        install_package(folder, module, package, "rtc3d_gateway.outputs", f"{name} = {package}:KIND")
        restore()
        add_installed_outputs()

    yield installing
    restore()


def read(folder: Path, **sections: Any) -> Settings:
    return configuration(folder, **sections).settings


def configuration(folder: Path, **sections: Any) -> loading.Configuration:
    file = folder / "lab.yaml"
    sources = [{"name": "lab", "host": "127.0.0.1"}]
    file.write_text(
        "\n".join(
            f"{key}: {json.dumps(value)}" for key, value in ({"sources": sources} | OFF | sections).items()
        )
    )
    return loading.read(file, settings_type(), {})


def test_an_installed_output_has_a_section_and_is_built(install: Install, tmp_path: Path) -> None:
    install(WORKING)
    assert UNUSABLE == {}
    settings = read(tmp_path, zenoh={"enabled": False}, example={"enabled": True, "address": "hall"})
    assert settings.outputs["example"] == ExampleSettings(enabled=True, address="hall")
    [output] = build_outputs(settings)
    assert isinstance(output, ExampleOutput)


def test_a_mistake_in_its_section_has_position_and_text_like_others(install: Install, tmp_path: Path) -> None:
    install(WORKING)
    with raises(ConfigError, "example.adress", "'address'"):
        read(tmp_path, example={"adress": "hall"})


BROKEN = {
    "cannot be imported": ("import nosuch", "ModuleNotFoundError: No module named 'nosuch'"),
    "ends the program": ("raise SystemExit('no licence')", "SystemExit: no licence"),
    "has no such object": ("", "AttributeError: module 'rtc3d_other' has no attribute 'KIND'"),
    "is of another type": ("KIND = 3", "rtc3d_other:KIND is of the type int, not OutputKind"),
    "has two names": (
        WORKING + "KIND = replace(KIND, name='other')",
        "its entry point is called 'example', and its OutputKind 'other'",
    ),
    "has settings without a default": (
        WORKING + "class Settings(OutputSettings):\n    port: int\nKIND = replace(KIND, settings=Settings)",
        "ValidationError: 1 validation error for Settings port missing; this key is required",
    ),
    "has no settings class": (WORKING + "KIND = replace(KIND, settings=None)", "TypeError: 'NoneType'"),
    "has settings of another class": (
        WORKING + "KIND = replace(KIND, settings=dict)",
        "its settings are of the type dict, not OutputSettings",
    ),
}


@pytest.mark.parametrize(("module", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_one_is_an_error_only_in_its_section(
    module: str, reason: str, install: Install, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A gateway without the section runs, and says why the output is missing."""
    before = schema_text(settings_type())
    install(module)
    text = f"the output example of the package rtc3d_other 1.2 cannot be used: {reason}"
    with pytest.raises(ConfigError) as error:
        read(tmp_path, example={"enabled": True})
    assert str(error.value).startswith(f"{tmp_path}/lab.yaml:4:10: example: {text}")
    assert names(str(error.value), "uninstall")
    assert "\n" not in str(error.value)

    found = configuration(tmp_path)
    with caplog.at_level(logging.WARNING):
        assert [output.name for output in build_outputs(found.settings)] == ["zenoh"]
    assert [(each.level, str(each.args[0]).startswith(text)) for each in logged(caplog)] == [
        ("WARNING", True)
    ]
    assert "example" not in shown_configuration(found)
    assert schema_text(settings_type()) == before


@pytest.mark.parametrize("name", ["zenoh", "sources", "json", "two-words"])
def test_a_name_that_is_not_free_changes_nothing_else(name: str, install: Install, tmp_path: Path) -> None:
    before = set(OUTPUTS)
    install(WORKING, name)
    assert set(OUTPUTS) == before
    assert names(UNUSABLE[name], repr(name))
    assert read(tmp_path, zenoh={"enabled": True}).outputs["zenoh"].enabled


def test_of_two_packages_with_one_name_the_first_is_used(install: Install, tmp_path: Path) -> None:
    install(WORKING, package="rtc3d_a")
    install(WORKING, package="rtc3d_b")
    assert names(UNUSABLE["example"], "rtc3d_b 1.2", "'example' is taken")
    assert read(tmp_path, example={"enabled": True}).outputs["example"].enabled


async def test_the_doctor_warns_of_a_broken_one(install: Install, tmp_path: Path) -> None:
    install("import nosuch")
    settings = read(tmp_path, zenoh={"enabled": False}, takes={"enabled": True, "directory": str(tmp_path)})
    findings = [finding async for finding in run_checks(settings, "lab.yaml", 0.0, connects=False)]
    [finding] = [finding for finding in findings if finding.subject == "example"]
    assert finding.result is Result.WARNING
    assert finding.found.endswith("ModuleNotFoundError: No module named 'nosuch'")
    assert names(finding.remedy, "uninstall")
