"""Messages for packages that are missing."""

import pytest

from thor2_jax.errors import InputError, needs_extra


def test_only_foreign_packages_need_an_extra() -> None:
    with pytest.raises(InputError, match="serve needs FastAPI.*fastapi"), needs_extra("serve", "FastAPI", "serve"):
        raise ModuleNotFoundError("No module named 'fastapi'", name="fastapi")
    with pytest.raises(ModuleNotFoundError), needs_extra("serve", "FastAPI", "serve"):
        raise ModuleNotFoundError("No module named 'thor2_jax.none'", name="thor2_jax.none")
