"""Names under which a local server may be addressed.

A web page can give its own name the address of a local server (DNS rebinding), and is then of the same origin. Its
requests still have that name in the header Host.
"""

import ipaddress
import re
from collections.abc import Iterable

from thor2_jax.errors import InputError

__all__ = ["check_host_names", "is_allowed_host"]

_NAME = re.compile(r"\[[0-9a-f:.]+\]|[a-z0-9_.-]+", re.ASCII | re.IGNORECASE)


def check_host_names(names: Iterable[str]) -> None:
    """Raise InputError unless every value of `--allow-host` is a host name or an address, without a port."""
    for name in names:
        if not (_NAME.fullmatch(name) or _address(name)):
            raise InputError(f"allow_host is {name!r}; expected a host name or an address, without a port")


def is_allowed_host(header: str, address: str, names: Iterable[str]) -> bool:
    """Return whether a request may have this header Host.

    Args:
        header: the header, a name or an address with or without a port.
        address: local address of the connection.
        names: names and addresses that are allowed besides it and those of the loopback interface.
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
