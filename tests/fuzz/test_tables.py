"""Damaged datasets, run directories and colour networks."""

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from dataset_files import READERS, write_dataset
from hypothesis import given, settings
from hypothesis import strategies as st
from small_runs import save_untrained_run

import colornet
import thor2_jax as thor2
from thor2_jax.model.run_directory import load_run
from thor2_jax.testing import damaged
from training.objects.builtin_objects import builtin_objects
from training.storage.jobs import MANIFEST
from training.views.dataset import ViewDataset, render_dataset
from training.views.mesh_views import RenderJob

from .conftest import other_content


@pytest.fixture(scope="module", params=READERS)
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, list[Path]]:
    """Return the reader of a dataset of two frames, and the tables and the cloud of the first one."""
    kind, path = request.param, tmp_path_factory.mktemp("dataset")
    write_dataset(kind, path)
    files = [*READERS[kind](path).files(0), *path.glob("names.*")]
    return (lambda: list(READERS[kind](path))), [f for f in files if f.suffix in (".json", ".yaml", ".pcd")]


@given(data=st.data())
def test_datasets(data: st.DataObject, dataset: tuple[Any, list[Path]], attempt: Any) -> None:
    """One table or cloud of a small dataset is damaged, and the whole dataset is read."""
    read, tables = dataset
    file = data.draw(st.sampled_from(tables))
    with other_content(file, data.draw(damaged(file.read_bytes()))):
        frames = attempt(read)
    assert frames is None or all(type(v) is str for item in frames for v in item.truth.values())


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("views")
    render_dataset(RenderJob({"ball": builtin_objects()["tennis_ball"]}, 360, 180), path)
    return path


def read_damaged(name: str, content: bytes, views: Path, attempt: Any) -> Any:
    """Read the dataset while a file has another content."""

    def read() -> list[Any]:
        dataset = ViewDataset.open(views)
        shards = [dataclasses.astuple(dataset.read(k)) for k in range(len(dataset.shards))]
        return [dataset.record | {"digest": ""}, dataset.classes, len(dataset), shards]

    with other_content(views / name, content):
        return attempt(read)


@pytest.mark.parametrize("name", [MANIFEST, "0000-0000.safetensors"])
@given(data=st.data())
def test_views(name: str, data: st.DataObject, views: Path, attempt: Any) -> None:
    """A file with another content is refused unless its meaning is the same."""
    whole = (views / name).read_bytes()
    loaded = read_damaged(name, data.draw(damaged(whole)), views, attempt)
    if loaded is not None:
        np.testing.assert_equal(loaded, read_damaged(name, whole, views, attempt))


def test_the_layout_of_a_manifest_does_not_matter(views: Path, attempt: Any) -> None:
    table = json.loads((views / MANIFEST).read_bytes())
    for same in (table, {"sha256": table["sha256"], **table}):
        assert read_damaged(MANIFEST, json.dumps(same).encode(), views, attempt) is not None
    assert read_damaged(MANIFEST, json.dumps({**table, "views": 2.0}).encode(), views, attempt) is None


NETWORK_FILE = (Path(colornet.__file__).parent / "data" / "network.npz").read_bytes()


@given(data=st.data())
def test_networks(data: st.DataObject, attempt: Any, tmp_path_factory: Any) -> None:
    """Damages the whole file, or one of its arrays in an archive with valid checksums."""
    path = tmp_path_factory.getbasetemp() / "network.npz"
    whole = data.draw(st.booleans())
    if whole:
        path.write_bytes(data.draw(damaged(NETWORK_FILE)))
    else:
        with zipfile.ZipFile(io.BytesIO(NETWORK_FILE)) as source, zipfile.ZipFile(path, "w") as target:
            name = data.draw(st.sampled_from(source.namelist()))
            for member in source.namelist():
                part = source.read(member)
                target.writestr(member, data.draw(damaged(part[:256], 1)) + part[256:] if member == name else part)
    network = attempt(lambda: colornet.load(path), (ValueError, OSError))
    if network is not None:
        assert not whole or network == colornet.load_default()  # some bytes are not read, as of a time stamp
        weights = network.membership(np.arange(300, dtype=np.uint16).astype(np.uint8).reshape(-1, 3))
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-6)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = save_untrained_run(tmp_path_factory.mktemp("run"), ("mug", "bowl"), ("ce",), record={"epochs": 3})
    assert load_run(path).classes == ("mug", "bowl")
    return path


@given(data=st.data())
def test_descriptions(data: st.DataObject, run: Path, attempt: Any) -> None:
    """A damaged run.json is refused or read as a run with valid types; weights are not restored here."""
    content = (run / "run.json").read_bytes()
    if data.draw(st.booleans()):
        other = data.draw(damaged(content))
    else:
        table = json.loads(content)
        key = data.draw(st.sampled_from(sorted(table)))
        part = data.draw(damaged(json.dumps(table[key]).encode()))
        other = json.dumps(table | {key: "PART"}).encode().replace(b'"PART"', part)

    def read() -> Any:
        with mock.patch("thor2_jax.model.run_directory.model_from_arrays"):
            return dataclasses.replace(load_run(run), classifiers={})

    with other_content(run / "run.json", other):
        loaded = attempt(read)
    if loaded is not None:
        assert isinstance(loaded.config, thor2.DescriptorConfig) and isinstance(loaded.record, dict)
        assert loaded.classes and all(isinstance(name, str) for name in loaded.classes)


@settings(max_examples=30)
@given(data=st.data())
def test_files_of_weights_and_network(data: st.DataObject, run: Path, attempt: Any) -> None:
    files = sorted(p for p in run.rglob("*") if p.is_file() and p.name != "run.json" and p.stat().st_size)
    path = data.draw(st.sampled_from(files))
    content = data.draw(damaged(path.read_bytes()))
    same = content == path.read_bytes()
    with other_content(path, content):
        loaded = attempt(lambda: same or load_run(run))
    assert (loaded is None) == (not same)


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 10**5, "1e400", "-1", "null", "10000000"])
def test_odd_numbers(value: str, run: Path, attempt: Any) -> None:
    """Sizes that would fill memory are compared with the shapes of the weights before any array is allocated."""
    table = json.loads((run / "run.json").read_bytes())
    for key in ("n_slices", "n_strips"):
        changed = table | {"descriptor_config": table["descriptor_config"] | {key: "PART"}}
        with other_content(run / "run.json", json.dumps(changed).replace('"PART"', value).encode()):
            assert attempt(lambda: load_run(run)) is None
