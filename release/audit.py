"""Check the locked versions in a requirements file for known vulnerabilities, with pip-audit and OSV.

    build/release-venv/bin/python -m release.audit [--osv-url URL] requirements.txt

Without an answer from OSV, it prints that it could not check. With CI=true, as in the release workflow, that is
an error. A vulnerability always is.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Print the result; end with status 1 for a vulnerability, or if CI could not check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--osv-url", default="https://api.osv.dev/v1/query")
    parser.add_argument("file")
    arguments = parser.parse_args()
    audit(arguments.file, arguments.osv_url)


def audit(file: str, osv_url: str) -> None:
    """Ask OSV about each package."""
    pip_audit = Path(sys.executable).with_name("pip-audit")
    options = [
        "--vulnerability-service=osv",
        f"--osv-url={osv_url}",
        "--require-hashes",
        "--disable-pip",
        "--progress-spinner=off",
    ]
    command = [str(pip_audit), *options, "--format=json", "--requirement", file]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        packages = json.loads(result.stdout)["dependencies"]
    except json.JSONDecodeError:  # it writes nothing if it fails
        reason = result.stderr.strip().rpartition("\n")[2]
        not_checked(f"{file}: {reason}")
        return
    if skipped := [package for package in packages if "skip_reason" in package]:
        not_checked("\n".join(package["skip_reason"] for package in skipped))
    found = [(package, found) for package in packages for found in package.get("vulns", [])]
    for package, vulnerability in found:
        fixed = ", ".join(vulnerability["fix_versions"]) or "none"
        print(f"{package['name']} {package['version']}: {vulnerability['id']}, fixed versions: {fixed}")
    if found:
        sys.exit(f"{file} has versions with known vulnerabilities. Run make lock, test, and commit.")
    print(f"{file}: {len(packages) - len(skipped)} packages have no known vulnerabilities.")


def not_checked(reason: str) -> None:
    """Print that packages were not checked; in CI, this is an error."""
    message = f"NOT CHECKED for known vulnerabilities: {reason}"
    if os.environ.get("CI") == "true":
        sys.exit(message)
    print(message, file=sys.stderr)


if __name__ == "__main__":
    main()
