"""The server of a page: where it listens, and which requests it answers."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import os
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

from .._common.checks import fail
from .scenery import optional

TRIED = 1000  # ports
_REPLACING = threading.Lock()


def open_server(host: str, port: int) -> Any:
    """A viser server on the first free port from `port` on, which refuses what other sites' pages ask for.

    ValueError for an address that this machine does not have, or no free port; ImportError where viser is missing, or
    does not let its requests be checked.
    """
    viser = optional("viser", "the viewer needs")
    port = _free_port(host, port)
    with _checked_requests(host) as checked, contextlib.redirect_stdout(io.StringIO()):  # it prints a banner
        server = viser.ViserServer(host=host, port=port, label="diffvbd", verbose=False)
        if not checked:
            server.stop()
            raise ImportError(f"viser: expected a version whose requests can be checked, got {viser.__version__}")
    server.request_share_url = _no_tunnel
    return server


def _no_tunnel(verbose: bool = True) -> None:
    """In place of viser's, which would connect to a server on the internet."""


def _free_port(host: str, port: int) -> int:
    """The first port that can be bound; viser would try for ever, and say nothing."""
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        _bind(places, 0)
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that is no domain name
        reason = getattr(error, "strerror", None) or f"{error}"
        fail("host", "the name or address of a network interface of this machine", f"{host!r}: {reason}")
    last = min(port + TRIED, 65536) - 1
    for tried in range(port, last + 1):
        try:
            _bind(places, tried)
        except OSError:
            continue
        return tried
    fail("port", f"a free port from {port} to {last}", "none")


def _bind(places: list[Any], port: int) -> None:
    """Raises OSError unless all these places can be listened on."""
    for family, kind, protocol, _, address in places:
        with socket.socket(family, kind, protocol) as tried:
            if os.name == "posix":  # elsewhere it would let two programs listen on one port
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                tried.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            tried.bind((address[0], port, *address[2:]))


def refusal(headers: Any, host: str) -> str:
    """Why a request with these headers is refused, or "".

    Two kinds of foreign page are kept out. One opens a connection to this server and has an Origin of its own. One has
    made its own name point to this machine (DNS rebinding), and that name is the Host.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _is_own(hosts[0], host):
        return f"Host: expected an address, localhost or {host}, got {', '.join(hosts) or 'none'}\n"
    own = hosts[0].lower()
    if any(origin.lower() not in (f"http://{own}", f"https://{own}") for origin in origins):
        return f"Origin: expected that of this page, {own}, got {', '.join(origins)}\n"
    return ""


def _is_own(asked: str, host: str) -> bool:
    """True if a Host header names this server by an address, which no other site can claim, or by its own name."""
    try:
        name = urlsplit(f"//{asked}").hostname or ""
    except ValueError:
        return False
    if name in ("localhost", host.lower(), socket.gethostname().lower()):
        return True
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


@contextlib.contextmanager
def _checked_requests(host: str) -> Iterator[list[str]]:
    """Inside, a viser server that starts checks each request, and is then in the list.

    viser has no option for that: the function of websockets with which it starts is replaced meanwhile.
    """
    import websockets.asyncio.server as module

    checked: list[str] = []

    def checking(answer: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
        def answered(connection: Any, request: Any) -> Any:
            reason = refusal(request.headers, host)
            if reason:
                return connection.respond(403, reason)
            return None if answer is None else answer(connection, request)

        return answered

    with _REPLACING:
        serve = module.serve

        def replaced(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
            if not handler.__module__.startswith("viser."):  # a server that another thread starts
                return serve(handler, *arguments, process_request=process_request, **options)
            checked.append(handler.__module__)
            return serve(handler, *arguments, process_request=checking(process_request), **options)

        module.serve = replaced  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield checked
        finally:
            module.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
