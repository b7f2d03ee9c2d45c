"""Accuracy of objects enrolled from labelled frames: `python -m benchmarks.enrollment DIR... [--test DIR]`.

The frames are split into four folds. The instances of each fold are recognized with a gallery of the other folds, with
all views and with one, three and five views of each object. The report also has the accuracy in groups of objects with
the same shape and different colours, and the rejection of unknown objects, a third of the objects at a time. With
--test, the views of all DIRs are enrolled, and the frames of --test are recognized once.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.prepared_instance import PreparedInstance, prepare_instance
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.enrollment import LOOKS, augmented_view, embed_looks
from thor2_jax.gallery.gallery import Gallery, GalleryObject
from thor2_jax.networks.embedding import Embedding, load_default
from training.evaluation.scores import auroc
from training.readers.frames import FrameFolder

FOLDS = 4
COPIES = 8
SAME_SHAPE = ("can_", "juice_box", "pringles", "book", "pen_")
"""Prefixes of names that differ in colour only."""

NO_CLOUDS = CompactClouds.of([])


class Instances:
    """Labelled instances of frames and their embeddings."""

    def __init__(self, directories: Sequence[Path], embedding: Embedding, with_copies: bool) -> None:
        views: list[PreparedInstance] = []
        names: list[str] = []
        frames: list[str] = []
        for directory in directories:
            for item in FrameFolder(directory):
                for label, name in sorted(item.truth.items()):
                    view = prepare_instance(item.frame, label, embedding.config.sigma_s)
                    if view.reason is None:
                        views.append(view)
                        names.append(name)
                        frames.append(f"{directory}/{item.identifier}")
        self.names, self.frames = np.array(names), np.array(frames)
        self.embeddings = embed(embedding, views)
        copies = [augmented_view(view, copy) for view in views for copy in range(COPIES)] if with_copies else []
        self.copies = embed(embedding, copies).reshape(len(views), -1, *self.embeddings.shape[1:])


def embed(embedding: Embedding, views: Sequence[PreparedInstance]) -> NDArray[np.float32]:
    """Return embeddings [V, K, D]."""
    order = np.argsort([len(view.points) for view in views], kind="stable")
    embedded = np.zeros((len(views), LOOKS, embedding.size), np.float32)
    if len(views):
        embedded[order] = embed_looks(embedding, [views[k] for k in order])
    return embedded


def gallery_of(instances: Instances, rows: NDArray[np.intp], n_views: int | None, seed: int = 0) -> Gallery:
    """Return a gallery of the instances in `rows`, with at most `n_views` of each object."""
    rng, gallery = np.random.default_rng(seed), Gallery("")
    for name in np.unique(instances.names[rows]):
        own = rows[instances.names[rows] == name]
        own = own if n_views is None else rng.permutation(own)[:n_views]
        views = instances.embeddings[own].reshape(-1, instances.embeddings.shape[-1])
        copies = instances.copies[own, : COPIES // len(own)].reshape(-1, views.shape[1])
        embeddings = np.concatenate([views, copies]).astype(np.float16)
        gallery = gallery.with_object(str(name), GalleryObject(embeddings, NO_CLOUDS, "frames", ""))
    return gallery


def answers(gallery: Gallery, instances: Instances, rows: NDArray[np.intp]) -> tuple[NDArray[np.str_], NDArray[Any]]:
    """Return the names and the scores of the answers."""
    scores = gallery.scores(instances.embeddings[rows])
    return np.array(gallery.names)[scores.argmax(axis=1)], scores.max(axis=1)


def leave_frames_out(instances: Instances, n_views: int | None, seed: int = 0) -> tuple[NDArray[np.str_], NDArray[Any]]:
    """Return the answer and its score for each instance, from a gallery of the other folds' frames."""
    frame = np.unique(instances.frames, return_inverse=True)[1]
    fold = np.random.default_rng(1).permutation(frame.max() + 1)[frame] % FOLDS
    names, scores = np.zeros_like(instances.names), np.zeros(len(instances.names))
    for k in range(FOLDS):
        rest, out = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        names[out], scores[out] = answers(gallery_of(instances, rest, n_views, seed), instances, out)
    return names, scores


def unknown_objects(instances: Instances) -> dict[str, float]:
    """Return the AUROC of known against unknown objects, with each third of the objects unknown in turn."""
    objects = np.unique(instances.names)
    frame = np.unique(instances.frames, return_inverse=True)[1] % 2
    known_scores, correct, unknown_scores = [], [], []
    for third in range(3):
        is_unknown = np.isin(instances.names, objects[third::3])
        for half in range(2):
            gallery = gallery_of(instances, np.flatnonzero((frame == half) & ~is_unknown), None)
            rows = np.flatnonzero((frame != half) & ~is_unknown)
            names, scores = answers(gallery, instances, rows)
            known_scores.append(scores)
            correct.append(names == instances.names[rows])
            unknown_scores.append(answers(gallery, instances, np.flatnonzero((frame != half) & is_unknown))[1])
    known, right, unknown = (np.concatenate(parts) for parts in (known_scores, correct, unknown_scores))
    threshold = float(np.quantile(known[right], 0.05))
    return {
        "auroc": auroc(np.concatenate([known, unknown]), np.arange(len(known) + len(unknown)) < len(known)),
        "threshold": threshold,
        "unknown_named": float((unknown >= threshold).mean()),
    }


def main() -> None:
    """Print and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=Path, nargs="+")
    parser.add_argument("--test", type=Path)
    parser.add_argument("--embedding", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "enrollment.json")
    options = parser.parse_args()
    embedding = Embedding.load(options.embedding) if options.embedding else load_default()
    instances = Instances(options.frames, embedding, with_copies=True)
    names, _ = leave_frames_out(instances, None)
    correct = names == instances.names
    report: dict[str, Any] = {"instances": len(correct), "objects": len(np.unique(instances.names))}
    report["all views"] = float(correct.mean())
    for n_views in (1, 3, 5):
        each = [(leave_frames_out(instances, n_views, seed)[0] == instances.names).mean() for seed in range(3)]
        report[f"{n_views} views"] = float(np.mean(each))
    for prefix in SAME_SHAPE:
        rows = np.char.startswith(instances.names, prefix)
        if rows.any():
            shape = np.char.startswith(names[rows], prefix)
            report[prefix] = {
                "instances": int(rows.sum()),
                "correct": float(correct[rows].mean()),
                "shape": float(shape.mean()),
                "color, where the shape is correct": float(correct[rows][shape].mean()) if shape.any() else None,
            }
    report["unknown objects"] = unknown_objects(instances)
    if options.test:
        test = Instances([options.test], embedding, with_copies=False)
        gallery = gallery_of(instances, np.arange(len(instances.names)), None)
        rows = np.flatnonzero(np.isin(test.names, gallery.names))
        report["test"] = {
            "instances": len(rows),
            "correct": float((answers(gallery, test, rows)[0] == test.names[rows]).mean()),
        }
    print(json.dumps(report, indent=1))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
