"""Build the sdist and the wheels of this repository: the same bytes from the same sources.

    python3.12 -m release.build [--dist FOLDER] [sdist|pure|compiled|wheel ...]

A compiled wheel is for the Python that runs this program. ``wheel`` is a compiled wheel if there is a C
compiler, and otherwise a pure one. This program needs nothing but Python: it installs the tools of the build
into a temporary folder.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import venv
from collections.abc import Iterator, Mapping, Set
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]


def main() -> None:
    """Parse the command line, and copy what is built into a folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dist", type=Path, default=ROOT / "dist", help="folder for what is built")
    parser.add_argument("kinds", nargs="+", choices=("sdist", "pure", "compiled", "wheel"), metavar="KIND")
    arguments = parser.parse_args()
    kinds = set(arguments.kinds)
    missing = missing_to_compile()
    if "compiled" in kinds and missing:
        sys.exit(f"Cannot compile for {sys.executable}; missing: {missing}.")
    if "wheel" in kinds:
        kinds = kinds - {"wheel"} | {"pure" if missing else "compiled"}
        if missing:
            print(
                f"Not compiled; missing: {missing} (Debian: apt-get install gcc python3-dev). "
                "The gateway works the same but needs more CPU time per frame."
            )
    os.umask(0o022)  # modes are part of the archives
    arguments.dist.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="rtc3d-gateway-") as folder:
        for built in build(kinds, Path(folder)):
            with complete_file(arguments.dist / built.name) as unfinished:
                shutil.copyfile(built, unfinished)
            print(arguments.dist / built.name)


def missing_to_compile() -> str:
    """Return what a compilation for this Python lacks, or an empty string."""
    header = Path(sysconfig.get_path("include"), "Python.h")
    missing = [] if shutil.which(_compiler()[0]) else [_compiler()[0]]
    return " and ".join([*missing, *([] if header.exists() else [str(header)])])


def build(kinds: Set[str], folder: Path) -> Iterator[Path]:
    """Build in ``folder``, which is empty and temporary, and yield the files in it.

    The wheels are built from the sdist, so it cannot lack what they need. mypyc writes its output beside the
    sources, where Python would import it instead of them, so each wheel has its own copy of the sources.
    """
    python = folder / "tools/bin/python"
    has_pip = find_spec("pip") is not None  # Debian's Python has none
    venv.create(folder / "tools", with_pip=not has_pip)
    pip = (sys.executable, "-m", "pip", f"--python={python}") if has_pip else (python, "-m", "pip")
    options = ("--disable-pip-version-check", "--quiet", "--no-compile", "--require-hashes")
    run(*pip, "install", *options, "--requirement", ROOT / "release/build-requirements.txt")
    environment = reproducible_environment()
    hatchling = (python, "-m", "hatchling", "build", "--directory", folder / "built", "--target")
    run(*hatchling, "sdist", cwd=ROOT, env=environment)
    [sdist] = (folder / "built").iterdir()
    if "sdist" in kinds:
        yield sdist
    for kind in kinds & {"pure", "compiled"}:
        (folder / kind).mkdir()
        run("tar", "--extract", "--no-same-owner", "--file", sdist, "--directory", folder / kind)
        [sources] = (folder / kind).iterdir()
        compiler = compiler_environment(folder) if kind == "compiled" else {}
        run(*hatchling, "wheel", cwd=sources, env={**environment, **compiler})
    yield from (folder / "built").glob("*.whl")


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Provide a hidden name, in the folder of ``path``, for a file that becomes ``path`` once it is complete.

    A build that is killed leaves nothing under a name that somebody would publish or install.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}")
    yield unfinished
    unfinished.replace(path)


def reproducible_environment() -> dict[str, str]:
    """Return environment variables for a build whose output depends on the sources only."""
    kept = {name: text for name, text in os.environ.items() if not name.startswith(("HATCH_", "PYTHON"))}
    environment = {**kept, "PYTHONHASHSEED": "0", "LC_ALL": "C.UTF-8", "TZ": "UTC"}
    if (ROOT / ".git").exists() and shutil.which("git"):
        # `sudo make install` runs as another user than the owner of the repository.
        commit_time = run("git", "-c", "safe.directory=*", "log", "-1", "--format=%ct", cwd=ROOT)
        environment["SOURCE_DATE_EPOCH"] = commit_time.strip()
    return environment


def compiler_environment(folder: Path) -> dict[str, str]:
    """Return environment variables that make mypyc compile, with no path of this machine in the output."""
    compiler = shlex.join(_compiler())
    flags = (
        os.environ.get("CFLAGS", ""),
        # Both flags together save 3 % of the instructions per frame: compiled modules call each other
        # directly, and Python's own functions without a stub.
        "-fvisibility=hidden -fno-plt",
        # mypyc compiles assertions, each with the name of its file, in a temporary folder with a random name.
        f"-ffile-prefix-map={folder}=. -Wno-builtin-macro-redefined '-D__FILE__=\"mypyc\"'",
    )
    return {
        "HATCH_BUILD_HOOK_ENABLE_MYPYC": "1",
        "CC": compiler,
        "CFLAGS": " ".join(flags),
        # Python's own value may have a folder of this machine as an rpath. mypyc adds debug information, in
        # which the folder of Python's headers is.
        "LDSHARED": f"{compiler} -shared -Wl,--strip-debug",
    }


def run(*command: str | Path, cwd: Path | None = None, env: Mapping[str, str] | None = None) -> str:
    """Run a command and return its output; if it fails, end this program with all it has printed."""
    result = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    if result.returncode:
        failed = shlex.join(map(str, command))
        sys.exit(f"{result.stdout}{result.stderr}\nThis command failed: {failed}")
    return result.stdout


def _compiler() -> list[str]:
    return shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")


if __name__ == "__main__":
    main()
