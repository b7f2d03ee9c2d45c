"""Time to search a gallery of 100,000 objects, and to enroll an object: `python -m benchmarks.gallery search|enroll`.

search  synthetic embeddings: time of a query of 16 embeddings, memory, and recall of the index
enroll  enrolling one more object from a mesh and from five views in a warm process with 60 objects; forgetting it

The command prints a table and writes gallery-search.json or gallery-enroll.json.
"""

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import seconds_of, time_calls
from thor2_jax.frames.prepared_instance import instance_view
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.enrollment import ObjectGallery
from thor2_jax.gallery.gallery import NEAREST, GalleryObject
from thor2_jax.gallery.search import ExactSearch, IndexSearch
from thor2_jax.model.run_directory import EMBEDDING_FILE, TrainedRun, save_run
from thor2_jax.networks.embedding import Embedding
from thor2_jax.recognizer import Recognizer
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of
from training.rendering.scenes import compose_scene
from training.views.mesh_views import mesh_views

SIZE = 256
QUERIES = 16


def synthetic_embeddings(n_objects: int, n_views: int, seed: int = 0) -> NDArray[np.float16]:
    """Return unit vectors [n_objects * n_views, SIZE], the views of each object around a random centre (cosine 0.8)."""
    rng = np.random.default_rng(seed)
    embeddings = np.empty((n_objects * n_views, SIZE), np.float16)
    for first in range(0, n_objects, 1000):
        count = min(1000, n_objects - first)
        centres = rng.standard_normal((count, 1, SIZE), np.float32)
        views = centres + 0.75 * rng.standard_normal((count, n_views, SIZE), np.float32)
        views /= np.linalg.norm(views, axis=-1, keepdims=True)
        embeddings[first * n_views : (first + count) * n_views] = views.reshape(-1, SIZE)
    return embeddings


def queries_near(embeddings: NDArray[np.float16], count: int, seed: int = 1) -> NDArray[np.float32]:
    """Return unit vectors [count, SIZE] as queries, each close to a random view."""
    rng = np.random.default_rng(seed)
    queries = embeddings[rng.integers(len(embeddings), size=count)].astype(np.float32)
    queries += rng.standard_normal(queries.shape, np.float32) * np.float32(0.75 / np.sqrt(SIZE))
    return queries / np.linalg.norm(queries, axis=1, keepdims=True)


def measure_search(options: argparse.Namespace) -> dict[str, Any]:
    """Return times, memory and recall of both searches."""
    report: dict[str, Any] = {"objects": options.objects, "size": SIZE, "queries": QUERIES, "nearest": NEAREST}
    embeddings = synthetic_embeddings(options.objects, options.views)
    queries, many = queries_near(embeddings, QUERIES), queries_near(embeddings, 200, seed=2)
    report["views"], report["embeddings_gigabytes"] = len(embeddings), embeddings.nbytes / 2**30
    exact = ExactSearch(embeddings).nearest(many, NEAREST)[1]
    for name, build in {"exact": ExactSearch, "usearch": IndexSearch}.items():
        start, processor = time.perf_counter(), time.process_time()
        search: ExactSearch | IndexSearch = build(embeddings)
        row = {"build_seconds": time.perf_counter() - start, "build_processor_seconds": time.process_time() - processor}
        row["query_seconds"] = time_calls(lambda: search.nearest(queries, NEAREST), least=3).median  # noqa: B023
        row["peak_gigabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        index = search.nearest(many, NEAREST)[1]
        for count in (1, 10, 50, NEAREST):
            hits = [len(np.intersect1d(*rows)) / count for rows in zip(exact[:, :count], index[:, :count], strict=True)]
            row[f"recall_at_{count}"] = float(np.mean(hits))
        report[name] = row
        print(name, json.dumps(row), flush=True)
    return report


def measure_enrollment(options: argparse.Namespace) -> dict[str, Any]:
    """Return the seconds to enroll an object from a mesh and from five views, and to forget it."""
    rng = np.random.default_rng(0)
    meshes = builtin_objects()
    scenes = [compose_scene(meshes, np.random.default_rng(k), n_objects=6) for k in range(8)]
    name = max(meshes, key=lambda each: sum(each in scene.truth.values() for scene in scenes))
    frames = [
        (scene.frame, label)
        for scene in scenes
        for label, truth in scene.truth.items()
        if truth == name and label in scene.frame.instances
    ][:5]
    embedding = Embedding.create()
    with tempfile.TemporaryDirectory() as temporary:
        model = Path(temporary) / "run"
        save_run(TrainedRun(embedding.config, embedding.network, (), {}, {}), model)
        embedding.save(model / EMBEDDING_FILE)
        recognizer = Recognizer.load(model)
        view = instance_view(*frames[0], embedding.config.sigma_s)
        clouds = CompactClouds.of([view] * 60)
        embeddings = rng.standard_normal((60, 120, embedding.size), np.float32)
        embeddings /= np.linalg.norm(embeddings, axis=-1, keepdims=True)
        views = {
            f"object {k}": GalleryObject(e.astype(np.float16), clouds, "mesh", "") for k, e in enumerate(embeddings)
        }
        recognizer.objects.add(views)
        report = {}
        for attempt in range(options.repeats + 1):  # the first repeat compiles
            before = [str(answer) for answer in recognizer.recognize(scenes[0].frame)]
            report["mesh"] = seconds_of(lambda: _enroll_mesh(recognizer.objects, meshes[name]))
            report["forget"] = seconds_of(lambda: recognizer.forget("new"))
            report[f"{len(frames)} views"] = seconds_of(lambda: recognizer.enroll("new", frames))
            recognizer.forget("new")
            report["answers restored"] = before == [str(answer) for answer in recognizer.recognize(scenes[0].frame)]
            print("compiling:" if attempt == 0 else "warm:", json.dumps(report), flush=True)
    return report


def _enroll_mesh(objects: ObjectGallery, mesh: Any) -> None:
    objects.enroll("new", mesh_views(mesh), "mesh", surfaces_of([mesh]).arrays)


def main() -> None:
    """Run one of the two measurements and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["search", "enroll"])
    parser.add_argument("--objects", type=int, default=100_000)
    parser.add_argument("--views", type=int, default=50, help="views of each object")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    report = measure_search(options) if options.what == "search" else measure_enrollment(options)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"gallery-{options.what}.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
