"""Names of objects in sentences."""

from thor2_jax.printable import first_names


def test_dots_stand_for_further_names_only() -> None:
    assert [first_names("abc"[:count], 2) for count in range(4)] == ["", "a", "a, b", "a, b, ..."]
