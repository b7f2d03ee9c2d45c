"""Listening sockets, allowed names of the host, tokens, and headers of pages, for the service and the live view.

A web page can give its own name the address of a local server (DNS rebinding) and then has the same origin. Its
requests still have that name in the header Host.
"""

import contextlib
import ipaddress
import re
import socket
from collections.abc import Iterable, Iterator

from thor2_jax.errors import InputError, refusing_os_errors

__all__ = ["check_host_names", "check_token", "is_allowed_host", "listening", "page_headers"]

BACKLOG = 2048
"""Largest number of connections that wait to be accepted."""

_NAME = re.compile(r"\[[0-9a-f:.]+\]|[a-z0-9_.-]+", re.ASCII | re.IGNORECASE)


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[tuple[socket.socket, str]]:
    """Listen on an address; yield the socket and the URL of the server.

    Args:
        host: address to listen on.
        port: port to listen on; 0 chooses a free one.

    Raises:
        InputError: the address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = host == "::" and socket.has_dualstack_ipv6()
    check_host_names([host], "host")
    if not 0 <= port <= 65_535:
        raise InputError(f"port is {port}; expected 0 to 65535, where 0 chooses a free one")
    with refusing_os_errors(f"port is {port} and host {host}, which cannot be used", "choose others"):
        listener = socket.create_server((host, port), family=family, backlog=BACKLOG, dualstack_ipv6=both)
    with listener:
        url_host = f"[{host}]" if ":" in host else host
        yield listener, f"http://{url_host}:{listener.getsockname()[1]}"


def page_headers(images: str, cache: str) -> dict[str, str]:
    """Return the headers of all responses of a server with a page.

    The page can only load from and connect to its own server, has no inline code and cannot be framed.

    Args:
        images: sources of images, as in a Content-Security-Policy.
        cache: value of Cache-Control.
    """
    return {
        "Content-Security-Policy": f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {images}; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": cache,
    }


def check_host_names(names: Iterable[str], argument: str = "allow_host") -> None:
    """Raise InputError unless every value of an argument is a host name or an address, without a port."""
    for name in names:
        if not (_NAME.fullmatch(name) or _address(name)):
            raise InputError(f"{argument} is {name!r}; expected a host name or an address, without a port")


def check_token(token: str | None) -> None:
    """Raise InputError unless a token can be sent in a header; None is no token."""
    if token is not None and not (token and token.isascii() and token.isprintable() and token == token.strip()):
        raise InputError(
            "token (--token or THOR2_TOKEN) is empty, or is not printable ASCII without blanks at its ends; expected "
            "such characters; leave it out for a service without a token"
        )


def is_allowed_host(header: str, address: str, names: Iterable[str]) -> bool:
    """Return whether a request may have this header Host.

    Args:
        header: the header, a name or an address with or without a port.
        address: local address of the connection.
        names: names and addresses that are allowed besides this address and those of the loopback interface.
    """
    name = re.sub(r":\d*$", "", header)
    if not _NAME.fullmatch(name):
        return False
    host = _address(name)
    if name.lower() == "localhost" or (host is not None and host.is_loopback):
        return True
    return (host or name.lower()) in {_address(allowed) or allowed.lower() for allowed in (address, *names)}


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address
