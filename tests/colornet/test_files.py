"""The record of the network and its file: read-only arrays, atomic writes, and one-line errors for damage."""

import dataclasses
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from failures import Pickled
from processes import finish_programs, start_program

import colornet
from colornet.files import read_arrays

NETWORK = colornet.load_default()
CONTENTS = {field.name: getattr(NETWORK, field.name) for field in dataclasses.fields(NETWORK)}

# Changes with the contents of the network, and with nothing else.
FINGERPRINT = "96981396ff3bc1ce0b440c5b781da4d2a5784b271f72967140e5b4b1bb6c593c"


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    NETWORK.save(path)
    again = colornet.load(str(path))
    for name, value in CONTENTS.items():
        np.testing.assert_array_equal(getattr(again, name), value, strict=True)
    colornet.save(again, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["again.npz", "network.npz"]


def test_arrays_are_read_only_copies() -> None:
    arrays = {name: np.array(value) for name, value in CONTENTS.items() if isinstance(value, np.ndarray)}
    copy = dataclasses.replace(NETWORK, **arrays)
    for name, array in arrays.items():
        array[0] = 0
        with pytest.raises(ValueError, match="read-only"):
            getattr(copy, name)[0] = 0
    assert copy.fingerprint == NETWORK.fingerprint


def test_fingerprint_distinguishes_networks() -> None:
    assert NETWORK.fingerprint == FINGERPRINT
    again = dataclasses.replace(NETWORK)
    assert again is not NETWORK and again == NETWORK and hash(again) == hash(NETWORK) and NETWORK != "network"
    changed = {name: np.array(getattr(NETWORK, name)) for name in ("mean_rgb", "edge_weights", "similarity")}
    for values in changed.values():
        values.flat[-1] += 1e-6
    changed |= {"cyclic": ~NETWORK.cyclic, "edges": NETWORK.edges[:, ::-1], "n_raw_nodes": 24}
    changed["region_bits"] = np.roll(NETWORK.region_bits, 1)
    others = [NETWORK, *(dataclasses.replace(NETWORK, **{name: value}) for name, value in changed.items())]
    assert len({other.fingerprint for other in others}) == len(set(others)) == 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean_rgb": np.zeros((22, 4))}, "mean_rgb is float64 [22, 4]; expected float64 [22, 3]"),
        ({"mean_rgb": np.float64(0)}, "mean_rgb is float64 []; expected"),
        ({"mean_rgb": np.zeros((0, 3))}, "member_counts is int64 [22]; expected int64 [0]"),
        (
            {"mean_rgb": np.zeros((33, 3)), "member_counts": np.zeros(33, np.int64), "similarity": np.zeros((33, 33))},
            "mean_rgb has 33 regions",
        ),
        ({"edge_weights": np.zeros(55, np.float32)}, "edge_weights is float32 [55]; expected float64 [55]"),
        ({"edges": np.full((55, 2), 22)}, "edges has regions 22 to 22"),
        ({"edges": np.full((55, 2), 23)}, "edges has regions 23 to 23"),
        ({"edges": np.full((55, 2), -1)}, "edges has regions -1 to -1"),
        ({"region_bits": np.zeros(140608, np.uint32)}, "region_bits[0] is 0"),
        ({"region_bits": np.full(140608, 1 << 22, np.uint32)}, "region_bits has 0x400000"),
        ({"similarity": np.full((22, 22), np.nan)}, "similarity has a value"),
    ],
)
def test_inconsistent_contents_are_rejected(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as direct:
        dataclasses.replace(NETWORK, **change)
    assert str(direct.value).startswith(message)
    path = tmp_path / "network.npz"
    np.savez(path, **{**CONTENTS, **change})
    with pytest.raises(ValueError) as loaded:
        colornet.load(path)
    assert str(loaded.value).startswith(str(path)) and str(loaded.value).endswith(str(direct.value))


def test_damaged_and_foreign_files_raise_one_line(tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    NETWORK.save(path)
    good, array, pickled = path.read_bytes(), io.BytesIO(), io.BytesIO()
    np.save(array, NETWORK.similarity)
    np.savez(pickled, mean_rgb=np.array([Pickled()], object))
    others = array.getvalue(), pickled.getvalue()
    for content in (b"", b"not a network\n" * 9, good[: len(good) // 2], good[:-1], *others):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"^{path} is damaged.*$"):
            colornet.load(path)
    np.savez(path, something=np.zeros(3))
    with pytest.raises(ValueError, match=r"\['something'\]"):
        colornet.load(path)


def test_arrays_up_to_the_limit_are_read(tmp_path: Path) -> None:
    size = 2**26 - 128  # an array's header takes 128 bytes
    np.savez_compressed(tmp_path / "file.npz", zeros=np.zeros(size, np.uint8))
    assert read_arrays(tmp_path / "file.npz")["zeros"].shape == (size,)
    np.savez_compressed(tmp_path / "file.npz", zeros=np.zeros(size + 1, np.uint8))
    with pytest.raises(ValueError, match="damaged"):
        read_arrays(tmp_path / "file.npz")


def test_paths_that_are_no_files_are_neither_read_nor_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link", "null\0"):
        for use in (colornet.load, NETWORK.save):
            with pytest.raises(OSError, match=name.strip("\0")):
                use(tmp_path / name)
    assert (tmp_path / "pipe").is_fifo() and len(os.listdir(tmp_path)) == 2


def test_loading_imports_neither_kmapper_nor_other_packages() -> None:
    script = "import colornet, sys; colornet.load_default().membership; print(*sys.modules)"
    (modules,) = finish_programs(start_program(script))
    assert not set(modules.split()) & {"kmapper", "sklearn", "colour", "matplotlib", "jax", "thor2_jax", "training"}
