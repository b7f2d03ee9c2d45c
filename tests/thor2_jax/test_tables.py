"""Tables in JSON and YAML files."""

import pytest

from thor2_jax import files


def test_shared_and_nested_yaml_values_are_read() -> None:
    assert files.parse_yaml(b"a: &row [1, 2]\nb: *row\n") == {"a": [1, 2], "b": [1, 2]}
    assert files.parse_yaml(b"[" * 50 + b"]" * 50) is not None
    assert files.parse_yaml(b"") is None


@pytest.mark.parametrize(
    "content",
    [b"[" * 5000, b"a: &b [*b]", b"? &b [x]\n: [*b, *c]", b"!!int ''", b"a: 0x" + b"f" * 5000, b"<<: {a: 1}"],
    ids=["deep", "cycle", "alias", "int", "digits", "merge"],
)
def test_damaged_yaml_is_a_value_error(content: bytes) -> None:
    with pytest.raises(ValueError):
        files.parse_yaml(content)


def test_yaml_has_a_largest_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_YAML_BYTES", 10)
    monkeypatch.setattr(files, "MAX_YAML_VALUES", 5)
    assert files.parse_yaml(b"[1,2,3,4]") == [1, 2, 3, 4]
    for content in (b"[1,2,3,4,5]", b"[1,1,1,1,]" + b" ", b"[1,1,1,1,1"):
        with pytest.raises(ValueError):
            files.parse_yaml(content)
