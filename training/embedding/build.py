"""Fit the packaged embedding on procedural objects: `python -m training.embedding.build --out FILE`.

The packaged file is the result of the default options; on two idle cores it takes about 900 s, half of it rendering. An
interrupted build keeps its samples in FILE.samples and resumes from them. `--meshes` adds the objects of a directory.
"""

import argparse
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import colornet
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding
from training.embedding.fit import EmbeddingFit, fit_embedding
from training.embedding.samples import build_samples
from training.embedding.views import ObjectSource
from training.objects.meshes import find_meshes
from training.storage.workers import local_workers

__all__ = ["build_embedding", "main"]

OBJECTS, VIEWS, EPOCHS = 2400, 12, 12
"""Procedural objects, views of each, and passes over their samples, for the packaged embedding."""


def build_embedding(
    out: Path,
    objects: int = OBJECTS,
    views: int = VIEWS,
    epochs: int = EPOCHS,
    meshes: Path | None = None,
    workers: int = 2,
    report: Callable[[str], object] = lambda line: None,
) -> Embedding:
    """Fit an embedding and write it to `out`; see the module.

    Args:
        out: file to write.
        objects: number of procedural objects.
        views: views of each object.
        epochs: passes over the samples.
        meshes: directory of other objects, as for `find_meshes`.
        workers: rendering processes; they do not affect the result.
        report: called with each line of progress.

    Raises:
        InputError: an option is out of range, a mesh is unreadable, or `out`.samples is of other options.
        OSError: a file cannot be written.
    """
    options = EmbeddingFit(epochs=epochs)
    sources: list[ObjectSource] = [*range(objects), *(find_meshes(meshes).values() if meshes else ())]
    network, config = colornet.load_default(), DescriptorConfig(homology="closed_form")
    directory, start = out.with_name(f"{out.name}.samples"), time.monotonic()

    def tell(line: str) -> None:
        report(f"{time.monotonic() - start:6.0f} s  {line}")

    samples = build_samples(
        sources,
        directory,
        network,
        config,
        views,
        pool=local_workers(workers),
        progress=lambda done, total: tell(f"views of {done} of {total} objects"),
    )
    embedding = fit_embedding(
        samples,
        network,
        config,
        options,
        progress=lambda done, total, loss: tell(f"epoch {done} of {total}: loss {loss:.3f}"),
    )
    embedding.save(out)
    shutil.rmtree(directory)
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
    options = vars(parser.parse_args(arguments))
    try:
        embedding = build_embedding(**options, report=lambda line: print(line, file=sys.stderr, flush=True))
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
    print(f"{options['out']}: {embedding.fingerprint}")


if __name__ == "__main__":
    main()
