"""Which folders are runs, and which runs may be evaluated together."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
from flax import nnx

import colornet
from thor2_jax.classifier import MLP
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.run_folder import TrainedRun, input_size, save_run
from training.evaluation.runs import load_runs, run_folders

CONFIG = DescriptorConfig(homology="closed_form", n_slices=1, n_strips=3)

Maker = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    """Write an untrained run of colour alone."""
    network = colornet.load_default()

    def make(
        name: str, classes: tuple[str, ...] = ("a", "b"), seed: int = 0, config: DescriptorConfig = CONFIG
    ) -> Path:
        model = MLP(input_size("ce", config, network.n_regions), len(classes), rngs=nnx.Rngs(seed))
        save_run(TrainedRun(config, network, classes, {"ce": model}, {}), tmp_path / name)
        return tmp_path / name

    return make


def test_folds_are_found_in_their_order(tmp_path: Path) -> None:
    for fold in (10, 2, 0):
        (tmp_path / "five" / f"fold-{fold}").mkdir(parents=True)
        (tmp_path / "five" / f"fold-{fold}" / "run.json").touch()
    (tmp_path / "single").mkdir()
    (tmp_path / "single" / "run.json").touch()
    found = run_folders([tmp_path / "single", tmp_path / "five"])
    assert [f.relative_to(tmp_path).as_posix() for f in found] == [
        "single",
        "five/fold-0",
        "five/fold-2",
        "five/fold-10",
    ]
    (tmp_path / "five" / "checkpoints").mkdir()
    with pytest.raises(InputError, match="five is not finished"):
        run_folders([tmp_path / "five"])
    assert run_folders([tmp_path / "five" / "fold-2"]) == [tmp_path / "five" / "fold-2"]


def test_folds_are_loaded_with_names_and_digests(make: Maker, tmp_path: Path) -> None:
    for fold in range(2):
        make(f"both/fold-{fold}", seed=fold)
    runs = load_runs([tmp_path / "both"])
    assert [run.name for run in runs] == ["both/fold-0", "both/fold-1"]
    assert len({run.digest for run in runs}) == 2
    assert [run.digest for run in load_runs([tmp_path / "both"])] == [run.digest for run in runs]


def test_runs_that_do_not_fit_together_are_refused(make: Maker, tmp_path: Path) -> None:
    first = make("first")
    cases = {
        "different classes (c)": make("classes", ("a", "b", "c")),
        "different classes (in another order)": make("order", ("b", "a")),
        "different descriptors": make("config", config=dataclasses.replace(CONFIG, alpha=0.5)),
        "the same run": first,
        "no run folder": tmp_path,
    }
    for said, other in cases.items():
        with pytest.raises(InputError, match="^model: ") as caught:
            load_runs([first, other])
        assert said in str(caught.value) and str(other) in str(caught.value)
    with pytest.raises(InputError, match="no run folder is given"):
        load_runs([])
