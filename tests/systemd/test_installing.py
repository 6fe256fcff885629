"""Installing with the commands of docs/how-to/service.md, on a disposable machine."""

import json
import shutil

import pytest

from tests.support.errors import names
from tests.support.needs import need
from tests.support.networks import free_port, zenoh_keys
from tests.systemd.machine import CONFIG, UNIT, Machine, Service, commands, exposure

pytestmark = [
    pytest.mark.systemd,
    pytest.mark.wheelhouse,
    pytest.mark.netns,
    pytest.mark.timeout(600),
]

PROGRAM = "/usr/local/bin/rtc3d-gateway"
PREFIX = "/opt/rtc3d-gateway"
VENV = f"{PREFIX}/venv"
MAN_PAGE = "/usr/local/share/man/man1/rtc3d-gateway.1"
COMPLETIONS = (
    "/usr/local/share/bash-completion/completions/rtc3d-gateway",
    "/usr/local/share/fish/vendor_completions.d/rtc3d-gateway.fish",
)
SCHEMA = "/etc/rtc3d-gateway/gateway.schema.json"
INSTALLED = (
    *(PROGRAM, PREFIX, SCHEMA, MAN_PAGE, *COMPLETIONS),
    *(f"/usr/local/lib/systemd/system/{unit}" for unit in (UNIT, "rtc3d-gateway@.service")),
    *(f"/usr/local/lib/{kind}.d/rtc3d-gateway.conf" for kind in ("sysusers", "tmpfiles")),
)
KEPT = "/opt/kept.tar"
SECRETS = "/etc/rtc3d-gateway/gateway.env"
INSTANCE = "rtc3d-gateway@hall-2.service"
WITHOUT_COMPILER = "export CC=no-such-compiler\n"


async def test_the_program_and_its_man_page_are_installed(machine: Machine) -> None:
    assert machine.path(PROGRAM).is_symlink()
    version = (await machine.run(PROGRAM, "--version")).text
    assert version.startswith("rtc3d-gateway ")
    await machine.run(PROGRAM, "config", "check", CONFIG)
    where = "import gateway, os; print(os.path.realpath(gateway.__file__))"
    assert (await machine.run(f"{VENV}/bin/python", "-c", where)).text.startswith(f"{VENV}/lib")
    page = machine.path(MAN_PAGE).read_text()
    assert page == (await machine.run(f"{VENV}/bin/python", "-P", "-m", "gateway.tools.cli.man_page")).text
    assert ".SS config check" in page
    assert machine.path(MAN_PAGE).stat().st_mode & 0o777 == 0o644
    assert all("_RTC3D_GATEWAY_COMPLETE=complete_" in machine.path(path).read_text() for path in COMPLETIONS)
    assert machine.left_in_clone == set()
    need("Not compiled" not in machine.install_output, machine.install_output)
    assert version.endswith(" (compiled)\n")


@pytest.mark.skipif(shutil.which("apt-get") is None, reason="the page names Debian packages")
async def test_the_packages_that_the_page_names_exist(machine: Machine) -> None:
    packages = commands("Install from source").partition("apt-get install ")[2].split()
    assert packages
    await machine.run("apt-get", "install", "--simulate", *packages)


def test_the_schema_in_the_configurations_first_line_is_installed(machine: Machine) -> None:
    first_line = machine.path(CONFIG).read_text().partition("\n")[0]
    assert first_line == "# yaml-language-server: $schema=gateway.schema.json"
    assert json.loads(machine.path(SCHEMA).read_text())["properties"]["sources"]
    assert machine.path(SCHEMA).stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("unit", [UNIT, "rtc3d-gateway@two.service"])
async def test_the_units_are_valid_and_sandboxed(machine: Machine, unit: str) -> None:
    assert (await machine.run("systemd-analyze", "verify", unit)).text == ""
    await machine.run("systemd-analyze", "security", "--threshold=20", unit)  # 2.0; fails above


async def test_only_the_service_and_root_can_read_the_secrets_folder(machine: Machine) -> None:
    secrets = machine.path("/etc/rtc3d-gateway/secrets")
    group = (await machine.run("stat", "--format=%U:%G", "/etc/rtc3d-gateway/secrets")).text.strip()
    assert group == "root:rtc3d-gateway"
    assert secrets.stat().st_mode & 0o7777 == 0o750


async def test_the_page_has_the_current_exposure_level(machine: Machine) -> None:
    figure, version = exposure()
    if not (here := (await machine.run("systemctl", "--version")).text).startswith(f"systemd {version} "):
        pytest.skip(f"the page's figure is for systemd {version}; this is {here.splitlines()[0]}")
    text = (await machine.run_shell(commands("What systemd does"))).text
    assert f"exposure level for {UNIT}: {figure} " in text


async def test_the_pages_commands_start_a_service_that_waits_for_its_server(service: Service) -> None:
    machine, away = service.machine, free_port()
    service.configure({"lab": away})
    assert names((await machine.run_shell(commands("Name the server"))).text, 1, "lab")
    started = (await machine.run_shell(commands("Start"))).text
    assert "active (running)" in started
    assert 'Status: "lab: ' in started
    assert await machine.show("UnitFileState") == "enabled"
    await service.wait_for_status(f"lab: waiting for 127.0.0.1:{away}, ")
    assert f"127.0.0.1:{away}" in (await machine.run_shell(commands("See what happened"))).text
    other = free_port()
    service.configure({"lab": other})
    await machine.run_shell(commands("Change the configuration"))
    await service.wait_for_status(f"lab: waiting for 127.0.0.1:{other}, ")


async def test_the_pages_commands_start_a_second_instance(service: Service) -> None:
    service.configure({"lab": free_port()})
    await service.machine.run_shell(commands("Several instances"))
    await service.machine.wait_for("StatusText", "lab: waiting for", INSTANCE)
    assert await service.machine.show("UnitFileState", INSTANCE) == "enabled"


async def test_a_secret_reaches_the_gateway_only(service: Service) -> None:
    machine = service.machine
    await machine.run_shell(commands("Secrets"))
    assert (await machine.run("stat", "--format=%a %U:%G", SECRETS)).text == "640 root:rtc3d-gateway\n"
    [line] = [line for line in commands("Secrets", 1).splitlines() if line.startswith("RTC3D_GATEWAY__")]
    zenoh = zenoh_keys("peer", listen=service.endpoint) | {"transport": {"auth": {"usrpwd": {"user": "me"}}}}
    service.configure({"lab": free_port()}, zenoh={"config": zenoh})
    machine.path(SECRETS).write_text(line.replace("…", "open-sesame"))
    try:
        await service.start()
        await service.wait_for_status("lab: waiting for")
        environment = machine.path(f"/proc/{await service.main_pid()}/environ").read_text()
        assert line.replace("…", "open-sesame") in environment.split("\0")
        assert "open-sesame" not in (await machine.run("systemctl", "show", UNIT)).text
        assert not any("open-sesame" in entry["MESSAGE"] for entry in await machine.journal())
    finally:
        machine.path(SECRETS).unlink()


async def test_upgrading_and_removing_keep_the_configuration(machine: Machine) -> None:
    mine = "sources: [{name: mine, host: 192.0.2.20}]\n"
    machine.write(CONFIG, mine)
    await machine.run("tar", "--create", "--absolute-names", "--file", KEPT, *INSTALLED)
    await machine.run_shell(WITHOUT_COMPILER + commands("Upgrade"))
    assert "compiled" not in (await machine.run(PROGRAM, "--version")).text
    assert machine.path(CONFIG).read_text() == mine
    await machine.run("systemctl", "enable", UNIT, INSTANCE)
    await machine.run_shell(commands("Remove", 2))
    try:
        assert not [path for path in INSTALLED if machine.path(path).exists()]
        left = await machine.run("systemctl", "list-unit-files", "rtc3d-gateway*", check=False)
        assert "0 unit files" in left.text
        assert machine.path(CONFIG).read_text() == mine
    finally:  # other tests use the installation
        await machine.run("tar", "--extract", "--absolute-names", "--file", KEPT)
        await machine.run("rm", KEPT)
        await machine.run("systemctl", "daemon-reload")
