"""The example that learns parameters of the descriptor."""

import runpy
from argparse import Namespace
from pathlib import Path

from refusals import assert_refused

from training.objects.builtin_objects import builtin_objects


def test_one_object_is_refused(tmp_path: Path) -> None:
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "learn_descriptor.py"))
    name, mesh = next(iter(builtin_objects().items()))
    compare = example["compare"]
    compare.__globals__["load_sets"] = lambda options: ({name: mesh}, {})
    options = Namespace(azimuth_step=180.0, polar_step=90.0, out=tmp_path)
    assert_refused("expected at least two; add views of another one", compare, options, [])
    assert not list(tmp_path.iterdir())
