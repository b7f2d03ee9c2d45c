"""Fit the packaged embedding on procedural objects: `python -m training.embedding.build --out FILE`.

The packaged network was fitted with the default options and the weaker augmentations of an earlier version, since a
gallery separates unknown objects less well with the present augmentations. Its principal components and reference views
were computed later (benchmarks/notes/accuracy.md). The fit took 1,280 s on two cores shared with other jobs: 90 s for
the views and 1,190 s for the fit itself. `--meshes` adds the objects of a folder. When the command is repeated, an
interrupted fit resumes from the directory FILE.checkpoints.
"""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

import colornet
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError, reason_of
from thor2_jax.files import check_output_file, locked, remove_written
from thor2_jax.networks.embedding import Embedding
from training.embedding.distractors import ObjectSource, sample_objects, samples_record
from training.embedding.fit import fit_embedding
from training.fitting.loop import Checkpoints, fit_progress
from training.objects.meshes import find_meshes
from training.storage.jobs import begin_job, of_stage
from training.storage.workers import local_workers

__all__ = ["build_embedding"]

MESH_WEIGHT = 6
"""Views of a mesh for each view of a procedural object, since a run must recognize its own objects best."""


def build_embedding(
    out: Annotated[Path, typer.Option(help="file to write (safetensors)")],
    objects: Annotated[int, typer.Option(min=2, help="procedural objects")] = 3000,
    views: Annotated[int, typer.Option(min=1, help="views of each object; 6 times as many of a mesh")] = 16,
    epochs: Annotated[int, typer.Option(min=1, help="passes over the samples")] = 20,
    meshes: Annotated[Path | None, typer.Option(help="folder of other objects (GLB, OBJ, PLY)")] = None,
    workers: Annotated[int, typer.Option(min=1, help="rendering processes; they do not affect the result")] = 2,
) -> None:
    """Fit an embedding and write it to a file; the error names a mesh or an output file that cannot be used."""
    check_output_file("out", out, lambda path: bool(Embedding.load(path)))
    of_meshes = find_meshes(meshes).values() if meshes else ()
    sources: list[ObjectSource] = [*range(objects), *(mesh for mesh in of_meshes for _ in range(MESH_WEIGHT))]
    network, config = colornet.load_default(), DescriptorConfig(homology="closed_form")
    arguments = sources, network, config, views
    job, directory = samples_record(*arguments) | {"epochs": epochs}, out.with_name(f"{out.name}.checkpoints")
    start = time.monotonic()

    def show(stage: str, done: int, total: int, note: str) -> None:
        print(f"{time.monotonic() - start:6.0f} s  {stage}: {done} of {total}, {note}", file=sys.stderr, flush=True)

    rendered, fitted = of_stage(show, "render", "objects"), fit_progress(show, "fit", epochs)
    with locked(directory):
        begin_job(directory, job)
        samples = sample_objects(*arguments, local_workers(workers), rendered, directory=directory / "samples")
        checkpoints = Checkpoints(directory / "networks")
        embedding = fit_embedding(samples, network, config, epochs, checkpoints, progress=fitted)
        embedding.save(out)
        remove_written(directory, r"job\.json", r"\.lock", r"(samples|networks)/[0-9]+\.safetensors")
    print(f"{out}: {embedding.fingerprint}")


if __name__ == "__main__":
    try:
        typer.run(build_embedding)
    except (InputError, OSError) as error:
        raise SystemExit(f"error: {reason_of(error)}") from None
