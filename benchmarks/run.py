"""Compare the library with a peer on the same clouds: `python -m benchmarks.run [--out DIRECTORY] [--quick]`.

The script prints tables and writes cpu.json and cpu.png. Compile times are reported separately, and all other figures
are medians of repeated calls. The peer runs in two processes.
"""

import argparse
import itertools
import json
import multiprocessing
import os
import platform
import resource
import time
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

import colornet
import thor2_jax as thor2
from benchmarks.clouds import make_frames, random_run, sample_clouds
from benchmarks.timing import time_calls
from thor2_jax.descriptor.describe import describe_stream

NETWORK = colornet.load_default()
CLOSED = thor2.DescriptorConfig(homology="closed_form")
GUDHI = thor2.DescriptorConfig(homology="gudhi")
BATCH, N_POINTS = 256, 2048
PEER_CLOUDS, PEER_PROCESSES = 64, 2


def peer_start() -> None:
    """Create the peer of this process."""
    global peer
    from benchmarks.peer import Peer

    peer = Peer()


def peer_describe(cloud: Any) -> float:
    return float(peer.describe(*cloud)[1].sum())


def peer_agrees(clouds: list[Any]) -> float:
    """Return the largest difference to the peer on the same aligned clouds, relative to the largest entry."""
    from benchmarks.peer import Peer

    other, worst = Peer(), 0.0
    aligned = thor2.align(thor2.PointClouds.pack(clouds), CLOSED)
    tops2 = np.asarray(thor2.describe_aligned(aligned, NETWORK, CLOSED).tops2)
    for k, (_, rgb) in enumerate(clouds):
        points = np.asarray(aligned.points[k])[np.asarray(aligned.mask[k])].astype(np.float64)
        expected = other.describe_aligned(points, rgb)[1]
        worst = max(worst, float(np.abs(tops2[k] - expected).max() / np.abs(expected).max()))
    return worst


def beside_peer(clouds: list[Any], rounds: int = 7) -> dict[str, Any]:
    """Return the clouds per second of the peer in two warm processes, and the library's speed relative to the peer.

    The peer and the library take turns, so that other load on the machine affects both. Values are medians over rounds.
    """
    packed = thor2.PointClouds.pack(clouds, N_POINTS)
    few = clouds[:PEER_CLOUDS]
    rates: list[float] = []
    ratios: dict[str, list[float]] = {"closed form": [], "gudhi": []}
    with multiprocessing.get_context("spawn").Pool(PEER_PROCESSES, peer_start) as pool:
        pool.map(peer_describe, few[:8], chunksize=4)
        for _ in range(rounds):
            start = time.perf_counter()
            pool.map(peer_describe, few, chunksize=8)
            rates.append(len(few) / (time.perf_counter() - start))
            for name, config in (("closed form", CLOSED), ("gudhi", GUDHI)):
                seconds = time_calls(lambda c=config: whole(packed, c), 0.3).median
                ratios[name].append(len(clouds) / seconds / rates[-1])
    return {"clouds_per_s": median(rates), "ratio": {name: median(values) for name, values in ratios.items()}}


def whole(packed: thor2.PointClouds, config: thor2.DescriptorConfig) -> Any:
    """Compute both descriptors from unaligned clouds."""
    descriptors = thor2.describe(packed, NETWORK, config)
    return descriptors.tops, descriptors.tops2


def engine_rates(clouds: list[Any]) -> dict[str, Any]:
    """Return the clouds per second of the complete pipeline and of its stages."""
    packed = thor2.PointClouds.pack(clouds, N_POINTS)
    aligned = thor2.align(packed, CLOSED)
    strips = thor2.strips(aligned, NETWORK, CLOSED)

    calls = {
        "whole, closed form": lambda: whole(packed, CLOSED),
        "whole, gudhi": lambda: whole(packed, GUDHI),
        "align": lambda: thor2.align(packed, CLOSED).points,
        "strips": lambda: thor2.strips(aligned, NETWORK, CLOSED),
        "images and embeddings, closed form": lambda: thor2.describe_strips(strips, NETWORK, CLOSED),
        "images and embeddings, gudhi": lambda: thor2.describe_strips(strips, NETWORK, GUDHI),
    }
    rates = {}
    for name, call in calls.items():
        timing = time_calls(call)
        rates[name] = {"clouds_per_s": len(clouds) / timing.median, "first_call_s": timing.first}
    return rates


def align_share(clouds: list[Any], rounds: int = 20) -> float:
    """Return the fraction of the alignment in the time of the pipeline (closed form), as the median over rounds."""
    packed = thor2.PointClouds.pack(clouds, N_POINTS)
    shares = []
    for _ in range(rounds):
        alone = time_calls(lambda: thor2.align(packed, CLOSED).points, 0.0).median
        shares.append(alone / time_calls(lambda: whole(packed, CLOSED), 0.0).median)
    return median(shares)


def against_size(quick: bool) -> dict[str, list[list[float]]]:
    """Return median seconds of `describe` (closed form) by number of points, for 64 clouds, and by number of clouds."""
    by_points, by_clouds = [], []
    for n in (512, 1024, 2048) if quick else (512, 1024, 2048, 4096, 8192):
        packed = thor2.PointClouds.pack(sample_clouds(64, n)[1], n)
        by_points.append([n, time_calls(lambda p=packed: thor2.describe(p, NETWORK, CLOSED), 1.0).median])
    for b in (1, 16, 256) if quick else (1, 4, 16, 64, 256, 1024, 4096):
        packed = thor2.PointClouds.pack(sample_clouds(b, N_POINTS)[1], N_POINTS)
        by_clouds.append([b, time_calls(lambda p=packed: thor2.describe(p, NETWORK, CLOSED), 1.0, 3).median])
    return {"points": by_points, "clouds": by_clouds}


def stream(clouds: list[Any], count: int) -> dict[str, float]:
    """Return the seconds that `describe_stream` takes for `count` clouds, and the peak memory of the process in GiB."""
    start = time.perf_counter()
    endless = itertools.islice(itertools.cycle(clouds), count)
    described = sum(len(descriptors.overflow) for descriptors in describe_stream(endless, NETWORK, CLOSED, N_POINTS))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"clouds": described, "seconds": time.perf_counter() - start, "peak_gib": peak}


def frame_latency(calls: int) -> dict[str, float]:
    """Return the milliseconds to recognize a decoded frame of 640 x 480 with six objects and three classifiers."""
    recognizer = thor2.Recognizer(random_run())
    frames = list(itertools.islice(make_frames(6), 32))
    times = []
    for f in itertools.islice(itertools.cycle(frames), len(frames) + calls):
        start = time.perf_counter()
        recognizer.recognize(thor2.RGBDFrame(f.color, f.depth, f.labels, f.intrinsics))
        times.append((time.perf_counter() - start) * 1e3)
    times = times[len(frames) :]  # the first calls compile
    return {"frames": len(frames), "p50_ms": float(np.percentile(times, 50)), "p99_ms": float(np.percentile(times, 99))}


def draw(sizes: dict[str, list[list[float]]], path: Path) -> None:
    """Plot times against the numbers of points and of clouds, with a fitted model: constant plus linear term."""
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    for axes, (name, rows) in zip(figure.subplots(1, 2), sizes.items(), strict=True):
        x, seconds = np.array(rows).T
        slope, fixed = np.polyfit(x, seconds, 1, w=1 / seconds)  # minimizes relative errors
        each = f"{slope * 1e6:.3g} µs a {'point' if name == 'points' else 'cloud'}"
        axes.loglog(x, seconds * 1e3, "o-", color="#0072b2", label="describe, closed form")
        axes.loglog(x, (fixed + slope * x) * 1e3, "--", color="#888888", label=f"{fixed * 1e3:.3g} ms + {each}")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("points per cloud (64 clouds)" if name == "points" else f"clouds ({N_POINTS} points each)")
        axes.set_xticks(x, [f"{int(size):,}" for size in x])
        axes.minorticks_off()
        axes.set_ylabel("milliseconds")
        axes.grid(color="#e5e5e5", which="both")
        axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run all measurements, print them, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="use fewer sizes and calls")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    name, clouds = sample_clouds(BATCH, N_POINTS)
    print(f"{BATCH} clouds of {N_POINTS} points, {name}; {os.cpu_count()} cores")
    rates = engine_rates(clouds)
    for part, rate in rates.items():
        print(f"{part:38s} {rate['clouds_per_s']:10,.0f} clouds/s   first call {rate['first_call_s']:.1f} s")
    share = align_share(clouds)
    print(f"alignment alone is {share:.0%} of the whole (closed form)")
    result: dict[str, Any] = {
        "machine": {"cores": os.cpu_count(), "processor": platform.machine(), "jax": jax.__version__},
        "clouds": {"count": BATCH, "points": N_POINTS, "what": name},
        "engine": rates,
        "align_share": share,
    }
    result["stream"] = stream(clouds, 10_000 if options.quick else 100_000)
    streamed = "describe_stream: {clouds:,} clouds in {seconds:.1f} s, peak memory {peak_gib:.2f} GiB"
    print(streamed.format(**result["stream"]))
    try:
        agreement = peer_agrees(clouds[:8])
    except ImportError as error:
        print(f"peer: not measured ({error}); it needs open3d, opencv and persim")
    else:
        peer = beside_peer(clouds)
        rate = f"{peer['clouds_per_s']:10,.0f} clouds/s"
        print(f"{'peer, two processes':38s} {rate}   same aligned clouds: differs by {agreement:.1e}")
        ratios = ", ".join(f"{name} {ratio:.1f}" for name, ratio in peer["ratio"].items())
        print(f"times as fast as the peer, in turns: {ratios}")
        result["peer"] = {"difference": agreement, **peer}
    result["frame"] = frame_latency(40 if options.quick else 200)
    print("frame of six objects: p50 {p50_ms:.1f} ms, p99 {p99_ms:.1f} ms".format(**result["frame"]))
    result["sizes"] = against_size(options.quick)
    for what, rows in result["sizes"].items():
        print(f"by {what}: " + ", ".join(f"{int(x)}: {s * 1e3:.1f} ms" for x, s in rows))
    draw(result["sizes"], options.out / "cpu.png")
    (options.out / "cpu.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
