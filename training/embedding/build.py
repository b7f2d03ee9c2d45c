"""Fit the packaged embedding on procedural objects: `python -m training.embedding.build --out FILE`.

The packaged network was fitted with the default options and the weaker augmentations of an earlier version: with the
present ones, a gallery separates unknown objects less well. The principal components and reference views beside it were
computed later (benchmarks/notes/accuracy.md). On two cores that other jobs shared, it took 1,280 s: 90 s for
the views and 1,190 s for the fit. An interrupted build resumes from the samples in FILE.samples, which are removed at
the end. `--meshes` adds the objects of a directory.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import colornet
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.files import check_output_directory, check_output_file, remove_written
from thor2_jax.gallery.embedding import Embedding
from training.embedding.fit import EmbeddingFit, fit_embedding, reference_views
from training.embedding.sampling import ObjectSource, build_samples
from training.fitting.loop import EpochMetrics
from training.objects.meshes import find_meshes
from training.storage.jobs import JOB_FILE, Progress, of_stage
from training.storage.workers import local_workers

__all__ = ["build_embedding", "main"]

OBJECTS, VIEWS, EPOCHS = 3000, 16, 20
"""Procedural objects, views of each, and passes over their samples, for the packaged embedding."""

MESH_WEIGHT = 6
"""Views of a mesh for each view of a procedural object: its own objects matter most to a run."""


def build_embedding(
    out: Path,
    objects: int = OBJECTS,
    views: int = VIEWS,
    epochs: int = EPOCHS,
    meshes: Sequence[Path] = (),
    workers: int = 2,
    progress: Progress = lambda stage, done, total, note: None,
) -> Embedding:
    """Fit an embedding and write it to a file, or resume an interrupted build.

    Args:
        out: file to write. The samples are in OUT.samples until it is written.
        objects: number of procedural objects.
        views: views of each procedural object; a mesh has `MESH_WEIGHT` times as many.
        epochs: passes over the samples.
        meshes: other objects, or their files.
        workers: rendering processes; they do not affect the result.
        progress: called with (stage, done, total, note).

    Raises:
        InputError: an option is out of range, a mesh is unreadable, or OUT.samples is of other options.
        OSError: a file cannot be written.
    """
    options = EmbeddingFit(epochs=epochs)
    sources: list[ObjectSource] = [*range(objects), *(mesh for mesh in meshes for _ in range(MESH_WEIGHT))]
    network, config = colornet.load_default(), DescriptorConfig(homology="closed_form")
    directory = out.with_name(f"{out.name}.samples")
    check_output_file("out", out, lambda path: bool(Embedding.load(path)))
    check_output_directory(directory, JOB_FILE)
    pool, show = local_workers(workers), of_stage(progress, "render for the embedding")
    samples = build_samples(sources, directory, network, config, views, pool=pool, progress=show)

    def report(done: int, total: int, metrics: EpochMetrics) -> None:
        progress("embedding", done, total, f"loss {metrics.loss:.3f}")

    embedding = fit_embedding(samples, network, config, options, progress=report)
    embedding = dataclasses.replace(embedding, references=reference_views(embedding, samples))
    embedding.save(out)
    remove_written(directory, r"job\.json", r"\.lock", r"[0-9]{5,}\.safetensors")
    return embedding


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m training.embedding.build", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="file to write (safetensors)")
    parser.add_argument("--objects", type=int, default=OBJECTS, help="procedural objects (%(default)s)")
    parser.add_argument("--views", type=int, default=VIEWS, help="views of each object (%(default)s)")
    parser.add_argument("--epochs", type=int, default=EPOCHS, help="passes over the samples (%(default)s)")
    parser.add_argument("--meshes", type=Path, help="directory of other objects (GLB, OBJ, PLY)")
    parser.add_argument("--workers", type=int, default=2, help="rendering processes (%(default)s)")
    options = parser.parse_args(arguments)
    start = time.monotonic()

    def show(stage: str, done: int, total: int, note: str) -> None:
        print(f"{time.monotonic() - start:6.0f} s  {stage}: {done} of {total} {note}", file=sys.stderr, flush=True)

    try:
        meshes = list(find_meshes(options.meshes).values()) if options.meshes else []
        numbers = options.objects, options.views, options.epochs
        embedding = build_embedding(options.out, *numbers, meshes, options.workers, show)
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
    print(f"{options.out}: {embedding.fingerprint}")


if __name__ == "__main__":
    main()
