"""The record of the network and its file: read-only arrays, atomic writes, and one-line errors for damage."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import colornet
from colornet.files import MAX_ARRAY_BYTES, read_arrays, read_file, write_arrays

# Changes with the contents of the network, and with nothing else.
FINGERPRINT = "96981396ff3bc1ce0b440c5b781da4d2a5784b271f72967140e5b4b1bb6c593c"


def contents(network: colornet.ColorNetwork) -> dict[str, Any]:
    return {field.name: getattr(network, field.name) for field in dataclasses.fields(network)}


def test_round_trip(network: colornet.ColorNetwork, tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    network.save(path)
    again = colornet.load(str(path))
    for name, value in contents(network).items():
        np.testing.assert_array_equal(getattr(again, name), value, strict=True)
    assert again.fingerprint == network.fingerprint
    colornet.save(again, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["again.npz", "network.npz"]


def test_packaged_file_is_small() -> None:
    assert (Path(colornet.__file__).parent / "data" / "network.npz").stat().st_size < 300_000


def test_arrays_are_read_only_copies(network: colornet.ColorNetwork) -> None:
    arrays = {
        name: np.array(value) if isinstance(value, np.ndarray) else value for name, value in contents(network).items()
    }
    copy = colornet.ColorNetwork(**arrays)
    arrays["mean_rgb"][0] = 0
    arrays["similarity"][0] = 0
    assert copy.fingerprint == network.fingerprint
    for name, value in contents(copy).items():
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[0] = 0
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(copy, name, value)


def test_fingerprint_distinguishes_networks(network: colornet.ColorNetwork) -> None:
    assert network.fingerprint == FINGERPRINT
    again = dataclasses.replace(network)
    assert again is not network and again == network and hash(again) == hash(network) and network != "network"
    assert dataclasses.replace(network, n_raw_nodes=24) != network
    fingerprints = {network.fingerprint}
    for name in ("mean_rgb", "edge_weights", "similarity"):
        changed = np.array(getattr(network, name))
        changed.flat[-1] += 1e-6
        fingerprints.add(dataclasses.replace(network, **{name: changed}).fingerprint)
    fingerprints.add(dataclasses.replace(network, cyclic=~network.cyclic).fingerprint)
    fingerprints.add(dataclasses.replace(network, edges=network.edges[:, ::-1]).fingerprint)
    fingerprints.add(dataclasses.replace(network, n_raw_nodes=24).fingerprint)
    swapped = np.array(network.region_bits)
    first, other = 0, int(np.flatnonzero(swapped != swapped[0])[0])
    swapped[[first, other]] = swapped[[other, first]]
    fingerprints.add(dataclasses.replace(network, region_bits=swapped).fingerprint)
    assert len(fingerprints) == 8


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
        ({"member_counts": np.zeros(22, np.int64)}, "member_counts is [0, 0"),
        ({"similarity": np.full((22, 22), np.nan)}, "similarity has a value"),
        ({"n_raw_nodes": 21}, "n_raw_nodes is 21"),
        ({"n_raw_nodes": 23.0}, "n_raw_nodes is 23.0"),
    ],
)
def test_inconsistent_contents_are_rejected(
    network: colornet.ColorNetwork, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError) as direct:
        dataclasses.replace(network, **change)
    assert str(direct.value).startswith(message)
    path = tmp_path / "network.npz"
    write_arrays(path, {name: np.asarray(value) for name, value in {**contents(network), **change}.items()})
    with pytest.raises(ValueError) as loaded:
        colornet.load(path)
    assert str(loaded.value).startswith(str(path)) and str(loaded.value).endswith(str(direct.value))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nothing-here.npz"):
        colornet.load(tmp_path / "nothing-here.npz")
    with pytest.raises(OSError):
        colornet.load(tmp_path)


def test_damaged_and_foreign_files_raise_one_line(network: colornet.ColorNetwork, tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    network.save(path)
    good = path.read_bytes()
    bad = {"empty": b"", "text": b"not a network\n" * 9, "half": good[: len(good) // 2], "end cut": good[:-1]}
    for name, data in bad.items():
        path.write_bytes(data)
        with pytest.raises(ValueError, match="damaged") as error:
            colornet.load(path)
        assert str(path) in str(error.value) and "\n" not in str(error.value), name
    with open(path, "wb") as stream:
        np.save(stream, network.similarity)
    with pytest.raises(ValueError, match="damaged"):
        colornet.load(path)
    write_arrays(path, {"something": np.zeros(3)})
    with pytest.raises(ValueError, match=r"\['something'\]"):
        colornet.load(path)


def test_pickled_objects_are_not_loaded(tmp_path: Path) -> None:
    class Hostile:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(tmp_path / "made"),)

    np.savez(tmp_path / "file.npz", mean_rgb=np.array([Hostile()], object))
    with pytest.raises(ValueError, match="damaged"):
        read_arrays(tmp_path / "file.npz")
    assert os.listdir(tmp_path) == ["file.npz"]


def test_arrays_up_to_the_limit_are_read(tmp_path: Path) -> None:
    assert MAX_ARRAY_BYTES == 64 * 1024**2
    header = 128  # bytes of an array's header
    for size, is_read in ((MAX_ARRAY_BYTES - header, True), (MAX_ARRAY_BYTES - header + 1, False)):
        write_arrays(tmp_path / "file.npz", {"zeros": np.zeros(size, np.uint8)})
        if is_read:
            assert read_arrays(tmp_path / "file.npz")["zeros"].shape == (size,)
        else:
            with pytest.raises(ValueError, match="damaged"):
                read_arrays(tmp_path / "file.npz")


def test_the_packaged_network_is_read_once() -> None:
    assert colornet.load_default() is colornet.load_default()


def test_flipped_bytes_are_refused_or_have_no_effect(network: colornet.ColorNetwork, tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    network.save(path)
    good = path.read_bytes()
    places = np.random.default_rng(0).choice(len(good), 150, replace=False).tolist() + list(range(-150, 0))
    refused = 0
    for place in places:
        data = bytearray(good)
        data[place] ^= 0x55
        path.write_bytes(data)
        try:
            assert colornet.load(path).fingerprint == network.fingerprint  # bytes that are not read, as of a time stamp
        except ValueError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 150


def test_pipes_and_devices_are_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="pipe"):
        write_arrays(tmp_path / "pipe", {"a": np.zeros(1)})
    assert (tmp_path / "pipe").is_fifo() and len(os.listdir(tmp_path)) == 1


def test_pipes_and_devices_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link"):
        with pytest.raises(OSError, match=name):
            read_file(tmp_path / name)


def test_saving_to_a_missing_directory_is_an_error(network: colornet.ColorNetwork, tmp_path: Path) -> None:
    with pytest.raises(OSError):
        network.save(tmp_path / "nowhere" / "network.npz")


def test_loading_imports_neither_kmapper_nor_other_packages() -> None:
    script = "import colornet, sys; colornet.load_default().membership; print(*sys.modules)"
    root = Path(colornet.__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"kmapper", "sklearn", "colour", "matplotlib", "jax", "thor2_jax", "training"}
