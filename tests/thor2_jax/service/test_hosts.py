"""Addresses and values of the header Host that a local server accepts."""

from refusals import assert_refused

from thor2_jax.service.hosts import check_host_names, is_allowed_host, listening

ALLOWED = """
    localhost LOCALHOST:8080 127.0.0.1:80 127.9.9.9 [::1] [::1]:8080 robot.local Robot.Local:1 10.0.0.7:80
    [fe80:0::7]:80 192.168.1.5:8080
""".split()
REFUSED = """
    :80 evil.example evil.example:8080 127.0.0.1.evil.example localhost.evil.example 127.0.0.1@evil.example robot.local.
    192.168.1.6 [::2] [::1 ::1x 2130706433 0x7f.1 l\u00f6calhost
""".split()


def test_loopback_the_address_and_listed_hosts_are_allowed() -> None:
    for address in ("192.168.1.5", "::ffff:192.168.1.5"):  # the second is that of a socket for both protocols
        headers = [*ALLOWED, *REFUSED, "", "localhost, evil.example"]
        assert [h for h in headers if is_allowed_host(h, address, ("robot.local", "10.0.0.7", "fe80::7"))] == ALLOWED


def test_other_names_and_addresses_are_refused() -> None:
    check_host_names(["robot.local", "10.0.0.7", "fe80::7", "[fe80::7]"])
    for name in ("", "robot.local:80", "http://robot.local", "*", "a b", "[::1]:80"):
        assert_refused("allow_host", check_host_names, [name])
    assert_refused("host is", listening("\u00e9" * 80, 0).__enter__)
    assert_refused("port is 70000", listening("127.0.0.1", 70_000).__enter__)
    assert_refused("host 203.0.113.9", listening("203.0.113.9", 0).__enter__)  # an address for documentation
