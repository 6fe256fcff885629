"""``make install`` and ``make uninstall``, on a machine that may be changed."""

import pytest

from tests.systemd.machine import CONFIG, UNIT, Machine

pytestmark = [pytest.mark.systemd, pytest.mark.wheelhouse, pytest.mark.netns]

PROGRAM = "/usr/local/bin/rtc3d-gateway"
UNITS = "/usr/local/lib/systemd/system"


async def test_the_program_runs_from_its_own_environment(machine: Machine) -> None:
    assert machine.path(PROGRAM).is_symlink()
    assert (await machine.run(PROGRAM, "--version")).text.startswith("rtc3d-gateway ")
    await machine.run(PROGRAM, "check", CONFIG)
    where = "import gateway, os; print(os.path.realpath(gateway.__file__))"
    location = await machine.run("/opt/rtc3d-gateway/venv/bin/python", "-c", where)
    assert location.text.startswith("/opt/rtc3d-gateway/venv/lib")


def test_installing_leaves_nothing_in_the_clone(machine: Machine) -> None:
    assert machine.left_in_clone == set()


@pytest.mark.parametrize("unit", [UNIT, "rtc3d-gateway@two.service"])
async def test_the_units_are_sound_and_locked_up(machine: Machine, unit: str) -> None:
    assert (await machine.run("systemd-analyze", "verify", unit)).text == ""
    await machine.run("systemd-analyze", "security", "--threshold=20", unit)  # 2.0; fails above


async def test_what_is_secret_is_for_the_service_and_root_alone(machine: Machine) -> None:
    secrets = machine.path("/etc/rtc3d-gateway/secrets")
    group = (await machine.run("stat", "--format=%U:%G", "/etc/rtc3d-gateway/secrets")).text.strip()
    assert group == "root:rtc3d-gateway"
    assert secrets.stat().st_mode & 0o7777 == 0o750


async def test_uninstalling_leaves_the_configuration_and_installing_takes_it_as_it_is(
    machine: Machine,
) -> None:
    machine.path(CONFIG).write_text("sources: [{name: mine, host: 192.0.2.20}]\n")
    await machine.run("systemctl", "enable", UNIT, "rtc3d-gateway@two.service")
    await machine.make("uninstall")
    try:
        for path in (PROGRAM, "/opt/rtc3d-gateway", f"{UNITS}/{UNIT}", f"{UNITS}/rtc3d-gateway@.service"):
            assert not machine.path(path).exists(), path
        left = await machine.run("systemctl", "list-unit-files", "rtc3d-gateway*", check=False)
        assert "0 unit files" in left.text
    finally:
        await machine.make("install")
    assert machine.path(CONFIG).read_text() == "sources: [{name: mine, host: 192.0.2.20}]\n"
