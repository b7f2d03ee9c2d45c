"""Compare the time to fit the TOPS2 classifier with common libraries: `python -m benchmarks.fit_peers --python PYTHON`.

PYTHON is an interpreter with torch, scikit-learn and NumPy; no other packages are needed. All libraries fit the same
layers with Adam on the same samples in batches of the same size, in turns of one epoch. This project expands its
samples to descriptors in every step, while the peers get the descriptors. Compilation is not timed.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

BATCH, TURNS, RATE = 256, 7, 1e-3
STEPS = ((20.0, 20.0), (60.0, 45.0))
"""Camera steps in degrees, by default and with --quick."""


def torch_epoch(x: np.ndarray, y: np.ndarray, hidden: list[int]) -> Callable[[], object]:
    """Return a function that fits one epoch with torch."""
    import torch

    layers: list[torch.nn.Module] = []
    for a, b in zip((x.shape[1], *hidden[:-1]), hidden, strict=True):
        layers += [torch.nn.Linear(a, b), torch.nn.BatchNorm1d(b), torch.nn.ReLU(), torch.nn.Dropout(0.2)]
    model = torch.nn.Sequential(*layers, torch.nn.Linear(hidden[-1], int(y.max()) + 1)).train()
    optimizer, loss_of = torch.optim.Adam(model.parameters(), RATE), torch.nn.CrossEntropyLoss()
    inputs, labels = torch.from_numpy(x), torch.from_numpy(y)

    def epoch() -> None:
        for rows in torch.randperm(len(x)).split(BATCH):
            optimizer.zero_grad()
            loss_of(model(inputs[rows]), labels[rows]).backward()
            optimizer.step()

    return epoch


def sklearn_epoch(x: np.ndarray, y: np.ndarray, hidden: list[int]) -> Callable[[], object]:
    """Return a function that fits one epoch with scikit-learn."""
    from sklearn.neural_network import MLPClassifier

    model, classes = MLPClassifier(hidden, batch_size=BATCH, learning_rate_init=RATE, alpha=0.0), np.unique(y)
    return lambda: model.partial_fit(x, y, classes=classes)


def own_epoch(folder: Path, steps: tuple[float, float]) -> Callable[[], object]:
    """Write the arrays for the peers, and return a function that fits one epoch with this project."""
    import jax
    import optax  # type: ignore[import-untyped]
    from flax import nnx

    import colornet
    from thor2_jax import DescriptorConfig
    from thor2_jax.networks.networks import HIDDEN, MLP
    from training.fitting.fit import FitContext, FitState, shard_batch, train_step
    from training.fitting.samples import describe_batch, sample_views
    from training.objects.builtin_objects import builtin_objects
    from training.views.mesh_views import render_views
    from training.views.normalized_views import MemoryViews

    network, config = colornet.load_default(), DescriptorConfig(homology="closed_form")
    source = MemoryViews(render_views(builtin_objects(), *steps), config)
    samples, _ = sample_views(source, network, config)
    context = FitContext("tops2", network, config)
    rows = np.arange(len(samples) // BATCH * BATCH)
    chunks = [samples.take(rows[first : first + BATCH], network, config) for first in range(0, len(rows), BATCH)]
    describe = jax.jit(lambda batch: describe_batch(batch, network, config).tops2)
    x = np.concatenate([describe(chunk) for chunk in chunks])
    for name, array in {"x": x, "y": samples.label[: len(rows)].astype(np.int64), "hidden": np.array(HIDDEN)}.items():
        np.save(folder / f"{name}.npy", array)
    model = MLP(x.shape[1], len(source.classes), rngs=nnx.Rngs(0))
    graph, state = FitState.initial(model, optax.adam(0.0))
    rng = np.random.default_rng(0)

    def epoch() -> None:
        nonlocal state
        order = rng.permutation(rows)
        for number, first in enumerate(range(0, len(order), BATCH)):
            batch = shard_batch(samples.take(order[first : first + BATCH], network, config))
            state, _ = train_step(context, graph, state, batch, np.float32(RATE), np.uint32(0), np.uint32(number))
        jax.block_until_ready(state)

    return epoch


PEERS = {"torch": torch_epoch, "scikit-learn": sklearn_epoch}


def serve_peer(name: str, folder: Path) -> None:
    """Fit an epoch for each line of standard input, and print its seconds."""
    x, y, hidden = (np.load(folder / f"{array}.npy") for array in ("x", "y", "hidden"))
    epoch = PEERS[name](x, y, hidden.tolist())
    for _ in sys.stdin:
        start = time.perf_counter()
        epoch()
        print(time.perf_counter() - start, flush=True)


def main() -> None:
    """Print the samples per second of each library, and its time divided by this project's time in the same turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", required=True, help="interpreter with torch and scikit-learn")
    parser.add_argument("--quick", action="store_true", help="fewer samples")
    parser.add_argument("--peer", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.peer:
        return serve_peer(args.peer, args.folder)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = own_epoch(folder, STEPS[args.quick])
        n_samples = len(np.load(folder / "y.npy"))
        command = [args.python, __file__, "--python", args.python, "--folder", name, "--peer"]
        processes = {
            peer: subprocess.Popen([*command, peer], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            for peer in PEERS
        }

        def seconds(library: str) -> float:
            if library in processes:
                process = processes[library]
                assert process.stdin is not None and process.stdout is not None
                print("epoch", file=process.stdin, flush=True)
                return float(process.stdout.readline())
            start = time.perf_counter()
            own()
            return time.perf_counter() - start

        times = [{library: seconds(library) for library in ("thor2", *PEERS)} for _ in range(TURNS + 1)][1:]
        for process in processes.values():
            process.communicate()
    for library in times[0]:
        rate = n_samples / statistics.median(turn[library] for turn in times)
        ratio = statistics.median(turn[library] / turn["thor2"] for turn in times)
        print(f"{library}: {rate:,.0f} samples a second, {ratio:.2f} times the time of thor2 ({n_samples:,} samples)")


if __name__ == "__main__":
    main()
