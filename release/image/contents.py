"""The packages of Debian in the container image."""

import gzip
import json
import re
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

from release.deb.packages import debian_purl

_STATUS: Final = "var/lib/dpkg/status"


def image_packages(archive: Path) -> Iterator[dict[str, Any]]:
    """Yield what dpkg has installed in an OCI archive of one image, as CycloneDX components."""
    for paragraph in _dpkg_status(archive).split("\n\n"):
        fields = dict(re.findall(r"^(Package|Version|Architecture|Status): (.*)$", paragraph, re.MULTILINE))
        if fields.get("Status", "").endswith(" installed"):
            name, version = fields["Package"], fields["Version"]
            purl = debian_purl(name, version, fields["Architecture"])
            yield {"type": "library", "name": name, "version": version, "purl": purl}


def _dpkg_status(archive: Path) -> str:
    """Return dpkg's list of packages from the last layer that has one."""
    status = ""
    with tarfile.open(archive) as image:

        def open_blob(descriptor: dict[str, Any]) -> IO[bytes]:
            return _open(image, "blobs/" + descriptor["digest"].replace(":", "/"))

        [manifest] = json.load(_open(image, "index.json"))["manifests"]
        for layer in json.load(open_blob(manifest))["layers"]:
            with gzip.open(open_blob(layer)) as unpacked, tarfile.open(fileobj=unpacked, mode="r|") as files:
                for file in files:
                    if file.name.removeprefix("./") == _STATUS:
                        status = _open(files, file).read().decode()
    return status


def _open(archive: tarfile.TarFile, member: str | tarfile.TarInfo) -> IO[bytes]:
    """Return the content of a file, which must be a regular one."""
    content = archive.extractfile(member)
    if content is None:
        raise ValueError(f"{member} is not a regular file")
    return content
