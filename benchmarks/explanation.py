"""Faithfulness of attributions on real frames: `python -m benchmarks.explanation --model RUN DIR...`.

For every instance, the tenth of the points with the highest attributions is removed, then each of 20 random tenths, and
the reduced clouds are recognized again. An attribution is faithful if removing the first tenth reduces the log-odds of
the answer more than removing a random tenth does on average. DIRs are folders of frames with label images; names of
objects are not needed.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from thor2_jax.explanation.attributions import Attributions, attribute_points
from thor2_jax.explanation.class_scores import ClassScores, classifier_scores
from thor2_jax.files import write_text
from thor2_jax.frames.prepared_instance import prepare_instance
from thor2_jax.recognizer import Recognizer
from training.readers.frames import find_frames

__all__ = ["faithfulness_of", "summary"]


def faithfulness_of(scores: ClassScores, directory: Path, sigma_s: float) -> Iterator[tuple[str, int, Attributions]]:
    """Yield, for every instance that can be described, the name of the frame, the label and the attributions."""
    for source in find_frames([directory]):
        frame = source.read()
        for label in frame.instances:
            instance = prepare_instance(frame, label, sigma_s)
            if instance.reason is None:
                index = int(scores.of_instances([instance])[0].argmax())
                yield source.name, label, attribute_points(scores, scores.orient(instance), instance, index)


def summary(checks: list[Attributions]) -> dict[str, float]:
    """Return the number of instances, the fraction of faithful attributions, and the median losses."""
    return {
        "instances": len(checks),
        "faithful": float(np.mean([check.holds for check in checks])),
        "loss_without_most_attributed_tenth": float(np.median([check.most_attributed for check in checks])),
        "loss_without_random_tenth": float(np.median([check.random for check in checks])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("directories", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--model", type=Path, required=True, help="run directory")
    parser.add_argument("--json", type=Path, help="file for the results")
    arguments = parser.parse_args()
    recognizer = Recognizer.load(arguments.model)
    scores = classifier_scores(recognizer.model)
    results = {}
    for directory in arguments.directories:
        checks = []
        for name, label, check in faithfulness_of(scores, directory, recognizer.run.config.sigma_s):
            checks.append(check)
            print(
                f"{directory.name}/{name} {label}: log-odds {check.margin:.2f}, without the most attributed tenth "
                f"{-check.most_attributed:+.2f}, without a random tenth {-check.random:+.2f}",
                flush=True,
            )
        results[directory.name] = summary(checks)
        print(json.dumps({directory.name: results[directory.name]}), flush=True)
    if arguments.json is not None:
        write_text(arguments.json, json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
