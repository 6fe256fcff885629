"""Write a bill of materials (CycloneDX, JSON) for each file of a release: FILE.cdx.json beside FILE.

    build/release-venv/bin/python -m release.sbom PYTHON FILE ...

PYTHON is the Python whose packages the files contain, or install.
"""

import copy
import hashlib
import json
import sys
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

from gateway import __version__
from release.build import ROOT, complete_file, reproducible_environment, run
from release.deb.packages import contained_packages, debian_purl
from release.image.contents import image_packages
from release.licences import licence_of
from release.packages import contents_of, mypy, packages_of


def main() -> None:
    """Write the bills, or end with the reason why one is not valid CycloneDX."""
    python, *files = sys.argv[1:]
    packages = bill_of_packages(python)
    for file in map(Path, files):
        text = json.dumps(bill_of_file(file, packages), indent=1, sort_keys=True)
        if error := JsonStrictValidator(SchemaVersion.V1_6).validate_str(text):
            sys.exit(f"The bill of materials of {file} is not valid CycloneDX: {error}")
        with complete_file(Path(f"{file}.cdx.json")) as unfinished:
            unfinished.write_text(text + "\n")


def bill_of_packages(python: str) -> dict[str, Any]:
    """Return a CycloneDX bill of the gateway and its packages, with what cyclonedx-py does not know."""
    tool = Path(sys.executable).with_name("cyclonedx-py")
    options = (
        "--pyproject",
        ROOT / "pyproject.toml",
        "--short-PURLs",
        "--output-reproducible",
        "--no-validate",
        "--sv",
        "1.6",
    )
    bill: dict[str, Any] = json.loads(
        run(tool, "environment", *options, python, env=reproducible_environment())
    )
    bill["metadata"]["component"] |= {"version": __version__, "purl": f"pkg:pypi/rtc3d-gateway@{__version__}"}
    packages = {package.name: package for package in packages_of(python)}
    bill["components"] = [
        component | described(packages[component["name"]])
        for component in bill["components"]
        if component["name"] in packages
    ]
    references = {component["bom-ref"] for component in [bill["metadata"]["component"], *bill["components"]]}
    bill["dependencies"] = [each for each in bill["dependencies"] if each["ref"] in references]
    return bill


def bill_of_file(file: Path, packages: dict[str, Any]) -> dict[str, Any]:
    """Return the bill of one file: that of the packages, with the name and hash of the file."""
    bill = copy.deepcopy(packages)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    bill["metadata"]["component"] |= {
        "hashes": [{"alg": "SHA-256", "content": digest}],
        "properties": [{"name": "file", "value": file.name}],
    }
    is_pure = file.name.startswith("rtc3d_gateway-") and file.name.endswith((".tar.gz", "-none-any.whl"))
    if not is_pure:
        version = mypy().version
        purl = f"pkg:pypi/mypy@{version}"
        runtime = {"type": "library", "name": "mypy", "version": version, "purl": purl}
        bill["components"].append(
            {**runtime, "description": "the runtime of the compiled modules", **described(mypy())}
        )
    if file.suffix == ".deb" or file.name.endswith(".oci.tar"):  # the image has the files of the package
        bill["components"] += [
            {
                "type": "library",
                "name": package.name,
                "version": package.version,
                "purl": debian_purl(package.name, package.version, "amd64"),
                "hashes": [{"alg": "SHA-256", "content": package.sha256}],
            }
            for package in contained_packages()
        ]
    if file.name.endswith(".oci.tar"):
        contained = {component["purl"] for component in bill["components"]}
        bill["components"] += [each for each in image_packages(file) if each["purl"] not in contained]
    return bill


def described(package: Distribution) -> dict[str, Any]:
    """Return the licence of a package and the libraries inside it, as fields of its component."""
    contents = [*contents_of(package)]
    licences = [{"expression": licence_of(package)}]
    return {"licenses": licences, **({"components": contents} if contents else {})}


if __name__ == "__main__":
    main()
