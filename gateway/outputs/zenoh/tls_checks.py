"""Why a TLS connection to a Zenoh endpoint fails: Zenoh itself only says that it does."""

import contextlib
import json
import re
import socket
import ssl
from pathlib import Path
from typing import Any, Final

import zenoh

_ENDPOINT: Final = re.compile(r"tls/(\[[^\]]+\]|[^:/?#]+):(\d+)")
_TIMEOUT_S: Final = 2.0
_ALERT_S: Final = 0.5
"""How long to wait for a refusal of this computer's certificate: with TLS 1.3, it comes after the rest."""


def tls_problem(endpoint: str, config: zenoh.Config) -> str:
    """Return why a connection with the certificates of ``config`` fails, and what to do after "; ".

    Returns "" if it does not fail, or if the endpoint is not one of TLS. It takes 2.5 s at most.
    """
    match = _ENDPOINT.match(endpoint)
    if match is None:
        return ""
    tls = json.loads(config.get_json("transport/link/tls"))
    try:
        context = ssl.create_default_context(cafile=tls["root_ca_certificate"])
        context.check_hostname = tls["verify_name_on_connect"] is not False
        # From 3.13 on, Python demands more of certificates than Zenoh does, such as a key usage extension.
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT
        if tls["connect_certificate"] and tls["connect_private_key"]:
            context.load_cert_chain(tls["connect_certificate"], tls["connect_private_key"])
    except OSError as error:
        return _file_problem(error, tls)
    host, port = match[1].strip("[]"), int(match[2])
    try:
        with (
            socket.create_connection((host, port), _TIMEOUT_S) as connection,
            context.wrap_socket(connection, server_hostname=host) as channel,
        ):
            channel.settimeout(_ALERT_S)
            with contextlib.suppress(TimeoutError):  # the router waits for Zenoh's first message
                channel.recv(1)
    except OSError as error:
        return _connection_problem(error, f"{host}:{port}")
    return ""


def _file_problem(error: OSError, tls: dict[str, Any]) -> str:
    if isinstance(error, ssl.SSLError):
        return f"the certificates in transport/link/tls cannot be used: {_reason(error)}; make them again"
    names = ("root_ca_certificate", "connect_certificate", "connect_private_key")
    missing = [f"{name} {tls[name]}" for name in names if tls[name] and not Path(tls[name]).is_file()]
    return f"{', '.join(missing) or 'transport/link/tls'}: {error.strerror}; correct transport/link/tls"


def _connection_problem(error: OSError, where: str) -> str:
    match error:
        case ssl.SSLCertVerificationError():
            return (
                f"the certificate of {where} is not accepted: {error.verify_message}; the router's "
                "certificate must come from the authority in root_ca_certificate, be valid today and contain "
                "the name or address in the endpoint"
            )
        case ssl.SSLError() if "ALERT" in (error.reason or ""):
            return (
                f"{where} refuses this computer's certificate: {_reason(error)}; connect_certificate must "
                "come from the authority that the router trusts and be valid today"
            )
        case ssl.SSLError() | TimeoutError():
            return f"{where} does not answer with TLS: {_reason(error)}; correct the endpoint"
        case _:
            return f"{where}: {error.strerror or error}; start the router, or correct the address"


def _reason(error: OSError) -> str:
    reason = error.reason if isinstance(error, ssl.SSLError) else None
    return (reason or str(error)).lower().replace("_", " ")
