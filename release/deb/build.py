"""Build the Debian package into dist/: the gateway, its own Python and the libraries that bare systems lack.

    python3.11 -m release.deb.build WHEEL WHEELHOUSE

WHEEL is the gateway compiled for Python 3.11, and WHEELHOUSE a folder with the
packages of requirements-view.txt. The same
commit and wheel give the same bytes: versions, hashes and times are fixed.
"""

import argparse
import email.utils
import gzip
import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

from gateway import __version__
from release.build import ROOT, complete_file, reproducible_environment, run
from release.deb.packages import LIST, contained_packages, debian_packages, download

HERE: Final = Path(__file__).parent
PREFIX: Final = "opt/rtc3d-gateway"
PYTHON: Final = f"{PREFIX}/python"
VENV: Final = f"{PREFIX}/venv"
LIBRARY: Final = "lib/python3.11"
DOCUMENTS: Final = "usr/share/doc/rtc3d-gateway"

# Only what minimal installations of Debian 12 and 13 and of Ubuntu 24.04 have, so that no network is needed.
# The distribution updates these libraries.
DEPENDS: Final = (
    *("libbz2-1.0", "libc6 (>= 2.36)", "libffi8 (>= 3.4)", "libgcc-s1 (>= 4.2)", "liblzma5", "libpcre2-8-0"),
    *("libssl3 (>= 3.0.0) | libssl3t64", "libstdc++6 (>= 11)", "libuuid1", "zlib1g"),
    *("systemd | systemd-standalone-sysusers", "systemd | systemd-standalone-tmpfiles"),
)
CONTROL: Final = """\
Package: rtc3d-gateway
Version: {version}
Architecture: amd64
Maintainer: RTC3D gateway maintainers <maintainers@example.org>
Installed-Size: {size_kib}
Depends: {depends}
Section: science
Priority: optional
Description: gateway from RTC3D motion-capture servers to Zenoh and LCM
 A service that receives live data of motion-capture servers with the protocol
 RTC3D (NDI First Principles, WaveFront), and publishes it on Zenoh and LCM.
 It also records, replays and exports takes, and has a simulator.
 .
 The package has its own Python and all Python packages, in tested versions, in
 /opt/rtc3d-gateway. It needs no network to install.
"""

CHANGELOG: Final = """\
rtc3d-gateway ({version}) unstable; urgency=medium

  * CHANGELOG.md.gz in this folder says what is new.

 -- RTC3D gateway maintainers <maintainers@example.org>  {date}
"""

# Modules that need libraries of their own, and tests.
UNUSED_OF_PYTHON: Final = (
    *("test", "sqlite3", "curses", "pydoc_data", "venv", "sitecustomize.py", "EXTERNALLY-MANAGED"),
    *("lib-dynload/*test*", "lib-dynload/xxlimited*"),
    *(f"lib-dynload/{name}.*" for name in ("_crypt", "_curses", "_curses_panel", "_dbm", "_sqlite3")),
    *(f"lib-dynload/{name}.*" for name in ("nis", "ossaudiodev", "readline")),
)

# Only these folders have programs. (Packages also mark libraries and data as executable.)
PROGRAMS: Final = tuple(f"{folder}/bin" for folder in (PYTHON, VENV))

# Tests, sources in C, programs and libraries for developers, and what pip notes about this machine. dpkg owns
# the files, so pip must not find a RECORD by which it would remove them.
UNUSED_OF_PACKAGES: Final = (
    *("bin", "include", "lib", "share", "**/tests", "**/*.a"),
    *(
        "**/*.c",
        "**/*.cpp",
        "**/*.h",
        "**/*.pxd",
        "**/*.pxi",
        "**/*.pyx",
        "viser/client/src",
        "viser/client/.gitignore",
    ),
    *("numpy/f2py", "numpy/distutils", "numpy/_core/*tests*.so"),
    *("*.dist-info/RECORD", "*.dist-info/REQUESTED", "*.dist-info/INSTALLER", "*.dist-info/direct_url.json"),
)


# The largest libraries with symbols. What auditwheel has changed, such as numpy, does not survive stripping.
STRIPPED: Final = ("foxglove/*.so", "uvloop/*.so", "zenoh/*.so")


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path)
    parser.add_argument("wheelhouse", type=Path)
    parser.add_argument(
        "--version", default=__version__, help="version of the package, for tests of upgrades"
    )
    parser.add_argument("--compression", default="xz", help="as for dpkg-deb; `none` is quick, for tests")
    parser.add_argument("--output", type=Path, default=ROOT / "dist")
    arguments = parser.parse_args()
    if sys.version_info[:2] != (3, 11):
        sys.exit("The package has the Python of Debian 12: build it there, with PYTHON=/usr/bin/python3.11.")
    os.umask(0o022)
    os.environ |= reproducible_environment()
    if "SOURCE_DATE_EPOCH" not in os.environ:
        sys.exit("The package has the time of its commit: build it in a clone, or set SOURCE_DATE_EPOCH.")
    with tempfile.TemporaryDirectory(prefix="rtc3d-gateway-deb-") as folder:
        debian, stage = Path(folder, "debian"), Path(folder, "stage")
        for package in debian_packages():
            run("dpkg-deb", "--extract", download(package), debian)
        stage_python(debian, stage)
        stage_packages(stage, arguments.wheel, arguments.wheelhouse)
        stage_shared_files(stage)
        stage_documents(debian, stage, arguments.version)
        compile_modules(stage)
        write_control_files(stage, arguments.version)
        print(
            pack(
                stage,
                arguments.output / f"rtc3d-gateway_{arguments.version}_amd64.deb",
                arguments.compression,
            )
        )


def stage_python(debian: Path, stage: Path) -> None:
    """Stage the private Python, and a virtual environment without packages."""
    python, venv = stage / PYTHON, stage / VENV
    shutil.copytree(debian / "usr" / LIBRARY, python / LIBRARY, symlinks=True)
    remove(python / LIBRARY, UNUSED_OF_PYTHON)
    libraries = debian / "usr/lib/x86_64-linux-gnu"
    for library in ("libglib-2.0.so.0", "libexpat.so.1"):
        found = next(
            folder / library
            for folder in (libraries, debian / "lib/x86_64-linux-gnu")
            if (folder / library).exists()
        )
        shutil.copyfile(found, python / "lib" / library)
    binary = python / "bin/python3.11"
    binary.parent.mkdir()
    shutil.copy(debian / "usr/bin/python3.11", binary)
    # DT_RPATH, other than DT_RUNPATH, also serves the modules that Python loads: lcm needs GLib.
    run(debian / "usr/bin/patchelf", "--force-rpath", "--set-rpath", "$ORIGIN/../lib", binary)

    (venv / "bin").mkdir(parents=True)
    (venv / "pyvenv.cfg").write_text(
        f"home = /{PYTHON}/bin\ninclude-system-site-packages = false\nversion = 3.11\n"
    )
    (venv / "bin/python3.11").symlink_to("../../python/bin/python3.11")
    for name in ("python", "python3"):
        (venv / "bin" / name).symlink_to("python3.11")


def stage_packages(stage: Path, wheel: Path, wheelhouse: Path) -> None:
    """Install the packages of requirements-view.txt, the gateway, and the program that starts it."""
    packages = stage / VENV / LIBRARY / "site-packages"
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--no-deps", "--no-index")
    folders = ("--find-links", wheelhouse, "--target", packages)
    run(*pip, *folders, "--require-hashes", "--requirement", ROOT / "requirements-view.txt")
    run(*pip, *folders, wheel)
    remove(packages, UNUSED_OF_PACKAGES)
    run("strip", "--strip-unneeded", *(path for pattern in STRIPPED for path in packages.glob(pattern)))
    program = stage / VENV / "bin/rtc3d-gateway"
    program.write_text(
        f"#!/{VENV}/bin/python\nimport sys\n\nfrom gateway.__main__ import main\n\n"
        'if __name__ == "__main__":\n    sys.exit(main())\n'
    )
    program.chmod(0o755)


def stage_shared_files(stage: Path) -> None:
    """Stage what an installation from source has, too: units, configuration, man page, completions."""
    # The staged Python runs from here, without its virtual environment, which names the final place.
    packages = stage / VENV / LIBRARY / "site-packages"
    python = f"env PYTHONPATH={packages} {stage / PYTHON}/bin/python3.11 -B"
    run("make", "-C", ROOT, "install-files", f"DESTDIR={stage}", "USR=/usr", f"PYTHON={python}")
    compress(stage / "usr/share/man/man1/rtc3d-gateway.1")
    # Editors look for the schema beside the configuration, but upgrades would keep a file there.
    schema = stage / "usr/share/rtc3d-gateway/gateway.schema.json"
    schema.parent.mkdir()
    (stage / "etc/rtc3d-gateway/gateway.schema.json").rename(schema)
    (stage / "etc/rtc3d-gateway/gateway.schema.json").symlink_to(
        "/usr/share/rtc3d-gateway/gateway.schema.json"
    )


def stage_documents(debian: Path, stage: Path, version: str) -> None:
    """Stage the changelog, and the licences of everything in the package."""
    documents = stage / DOCUMENTS
    documents.mkdir(parents=True)
    shutil.copyfile(HERE / "copyright", documents / "copyright")
    shutil.copyfile(ROOT / "CHANGELOG.md", documents / "CHANGELOG.md")
    (documents / "changelog").write_text(
        CHANGELOG.format(version=version, date=email.utils.formatdate(int(os.environ["SOURCE_DATE_EPOCH"])))
    )
    for name in ("CHANGELOG.md", "changelog"):
        compress(documents / name)
    for package in contained_packages():
        copyright_file = debian / "usr/share/doc" / package.name / "copyright"
        shutil.copyfile(copyright_file, documents / f"copyright.{package.name}")
    shutil.copyfile(LIST, documents / "debian-packages")
    overrides = stage / "usr/share/lintian/overrides/rtc3d-gateway"
    overrides.parent.mkdir(parents=True)
    shutil.copyfile(HERE / "lintian-overrides", overrides)


def remove(folder: Path, patterns: tuple[str, ...]) -> None:
    """Remove files and folders by patterns, each of which must match."""
    for pattern in patterns:
        found = list(folder.glob(pattern))
        if not found:
            sys.exit(f"{pattern}, which the package should not contain, matches nothing in {folder}.")
        for path in found:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)  # its folder may have been removed first


def compress(path: Path) -> None:
    """Replace a file by its compressed form, without name and time."""
    path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes(), 9, mtime=0))
    path.unlink()


def compile_modules(stage: Path) -> None:
    """Write the bytecode of all modules; only dpkg changes them, so Python need not compare the two."""
    options = ("-q", "-f", "--invalidation-mode=unchecked-hash", f"-s{stage}", "-p/")
    run(stage / PYTHON / "bin/python3.11", "-m", "compileall", *options, stage / PREFIX)


def write_control_files(stage: Path, version: str) -> None:
    """Write DEBIAN/, which dpkg-deb does not pack as files of the package."""
    control = stage / "DEBIAN"
    control.mkdir()
    files = sorted(path for path in stage.rglob("*") if path.is_file() and not path.is_symlink())
    size_kib = sum((path.stat().st_size + 1023) // 1024 for path in files)
    (control / "control").write_text(
        CONTROL.format(version=version, size_kib=size_kib, depends=", ".join(DEPENDS))
    )
    (control / "conffiles").write_text("/etc/rtc3d-gateway/gateway.yaml\n")
    sums = {path: hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest() for path in files}
    (control / "md5sums").write_text("".join(f"{sums[path]}  {path.relative_to(stage)}\n" for path in files))
    for name in ("preinst", "postinst", "prerm", "postrm"):
        shutil.copyfile(HERE / name, control / name)
        (control / name).chmod(0o755)


def pack(stage: Path, output: Path, compression: str) -> Path:
    """Write the package; modes, owners, times and the number of threads do not depend on the machine."""
    time_s = int(os.environ["SOURCE_DATE_EPOCH"])
    for path in stage.rglob("*"):
        if not path.is_symlink():
            program = any(path.is_relative_to(stage / folder) for folder in ("DEBIAN", *PROGRAMS))
            path.chmod(0o755 if path.is_dir() or (program and path.stat().st_mode & 0o100) else 0o644)
        os.utime(path, (time_s, time_s), follow_symlinks=False)
    options = ("--root-owner-group", f"-Z{compression}", "--threads-max=2")
    with complete_file(output) as unfinished:
        run("dpkg-deb", *options, "--build", stage, unfinished)
    return output


if __name__ == "__main__":
    main()
