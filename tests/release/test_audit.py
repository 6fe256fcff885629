"""The check for known vulnerabilities never takes silence for a good answer."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

import pytest

from tests.support.builds import release

VULNERABLE: Final = "old"


class Osv(BaseHTTPRequestHandler):
    """Answers like https://api.osv.dev: it knows one vulnerability, in one package."""

    def do_POST(self) -> None:
        query = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        name = query["package"]["name"]
        events = [{"introduced": "0"}, {"fixed": "1.1"}]
        affected = {
            "package": {"name": name, "ecosystem": "PyPI"},
            "ranges": [{"type": "ECOSYSTEM", "events": events}],
        }
        vulnerability = {"id": "PYSEC-1", "summary": "A flaw.", "affected": [affected]}
        answer = json.dumps({"vulns": [vulnerability]} if name == VULNERABLE else {}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_arguments: object) -> None:
        pass


@pytest.fixture
def osv_url() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Osv) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@pytest.fixture
def requirements(tmp_path: Path) -> Path:
    return tmp_path / "requirements.txt"


def lock(requirements: Path, *names: str) -> None:
    requirements.write_text("".join(f"{name}==1.0 --hash=sha256:{'0' * 64}\n" for name in names))


def test_a_known_vulnerability_is_an_error(requirements: Path, osv_url: str) -> None:
    lock(requirements, "harmless", VULNERABLE)
    result = release("-m", "release.audit", f"--osv-url={osv_url}", requirements)
    assert result.returncode == 1
    assert result.stdout == "old 1.0: PYSEC-1, fixed versions: 1.1\n"


def test_without_known_vulnerabilities_the_check_says_how_many_packages_it_asked_about(
    requirements: Path, osv_url: str
) -> None:
    lock(requirements, "harmless", "innocent")
    result = release("-m", "release.audit", f"--osv-url={osv_url}", requirements)
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"{requirements}: 2 packages have no known vulnerabilities.\n"


@pytest.mark.parametrize(("ci", "status"), [("false", 0), ("true", 1)])
def test_without_an_answer_the_check_says_so_and_fails_in_ci(
    requirements: Path, ci: str, status: int
) -> None:
    lock(requirements, "harmless")
    result = release("-m", "release.audit", "--osv-url=http://127.0.0.1:9/", requirements, CI=ci)
    assert result.returncode == status
    assert f"NOT CHECKED for known vulnerabilities: {requirements}: " in result.stderr
    assert "no known vulnerabilities" not in result.stdout
