"""The small installation: recognition and the service import none of the packages that only training needs."""

import json
import re
import sys
import tomllib
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from image_files import small_frame, write_frame_files
from processes import run_python
from refusals import assert_refused
from rendered_objects import write_box
from small_clouds import NETWORK, random_clouds
from small_runs import save_untrained_run

import thor2_jax as thor2
from training.cli.app import TRAINING_PACKAGES

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = {"colour": "colour-science", "sklearn": "scikit-learn"}

PROGRAM = """
import sys
for package in {packages!r}:
    sys.modules[package] = None  # importing it raises ModuleNotFoundError
import training.cli
sys.argv = ["thor2", *{arguments!r}]
{before}
training.cli.main()
"""


def run_without(*arguments: object, before: str = "") -> CompletedProcess[str]:
    """Run the command line in a process in which the packages of training cannot be imported."""
    program = PROGRAM.format(packages=TRAINING_PACKAGES, arguments=[*map(str, arguments)], before=before)
    return run_python("-c", program)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_untrained_run(tmp_path_factory.mktemp("run"), ("bowl", "mug"), ("tops", "tops2"))


RECOGNITION = (
    "import thor2_jax.service.server, thor2_jax.client, thor2_jax.segmentation.table, thor2_jax.export, "
    "thor2_jax.recordings.bags, thor2_jax.recordings.detection_files, thor2_jax.watch.live, training.frame_recognition"
)


def test_recognition_and_the_service_import_no_package_of_training(model: Path) -> None:
    ended = run_without("objects", "--model", model, before=RECOGNITION)
    assert ended.returncode == 0 and "bowl" in ended.stdout, ended.stderr


@pytest.mark.slow
def test_recognition_needs_no_package_of_training(model: Path, tmp_path: Path) -> None:
    write_frame_files(tmp_path, small_frame())
    ended = run_without("recognize", "--model", model, tmp_path, "--json")
    assert ended.returncode == 0, ended.stderr
    assert [one["label"] for one in json.loads(ended.stdout)["instances"]] == [1, 4]


def test_a_command_that_needs_training_says_so(tmp_path: Path) -> None:
    meshes = write_box(tmp_path / "meshes" / "box.ply", [0.1] * 3).parent
    ended = run_without("render", "--meshes", meshes, "--out", tmp_path / "views")
    assert ended.returncode == 2 and not (tmp_path / "views").exists()
    assert re.fullmatch(r"error: embreex is not installed; .*docs/install.md\n", ended.stderr)


def test_training_on_given_views_needs_no_ray_caster() -> None:
    """Neither embreex nor gudhi has wheels for ARM on Linux."""
    program = "import sys; sys.modules |= dict.fromkeys(('embreex', 'gudhi')); import training.train_job"
    ended = run_python("-c", program)
    assert ended.returncode == 0, ended.stderr


def test_gudhi_is_needed_only_where_it_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = thor2.PointClouds.pack(random_clouds(0, [9]))
    monkeypatch.setitem(sys.modules, "gudhi", None)
    config = thor2.DescriptorConfig(homology="gudhi", n_slices=2)
    assert_refused("homology is .*closed_form", thor2.describe, clouds, NETWORK, config)


def names(requirements: list[str]) -> dict[str, str]:
    """Return the name of each distribution -> its requirement without the marker."""
    plain = [requirement.partition(";")[0].strip() for requirement in requirements]
    return {re.split(r"[<>=!\[ ]", each)[0].lower(): each for each in plain}


def test_requirements_are_those_of_the_project() -> None:
    lines = (ROOT / "requirements-recognition.txt").read_text().splitlines()
    listed = names([line for line in lines if line and not line.startswith("#")])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    full = names(project["dependencies"])
    needed = full | names(extras["serve"]) | names(extras["segment"])
    training = {DISTRIBUTIONS.get(name, name) for name in TRAINING_PACKAGES} | {"optax"}
    assert training <= set(full)
    assert listed == {name: requirement for name, requirement in needed.items() if name not in training}
