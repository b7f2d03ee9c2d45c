"""Throughput on an accelerator, absolute and relative to its limits: `python -m benchmarks.run_gpu`.

The command prints a table and writes gpu.json with the name of the device. XLA's cost analysis counts the bytes and
operations of the compiled functions; `LIMITS` holds the limits of the device.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax

import colornet
import thor2_jax as thor2
from benchmarks.clouds import sample_clouds
from benchmarks.timing import time_calls

LIMITS = {"NVIDIA H100 80GB HBM3": (3.35e12, 67e12), "NVIDIA H200": (4.8e12, 67e12)}
"""Device -> memory bandwidth in bytes/s, and float32 operations/s without tensor cores, from its data sheet."""

BATCH, N_POINTS = 4096, 2048


def cost(function: Any, *arguments: Any) -> tuple[float, float]:
    """Return the bytes and operations of one call as counted by XLA, without the gudhi callback."""
    analysis = jax.jit(function).lower(*arguments).compile().cost_analysis() or {}
    return float(analysis.get("bytes accessed", 0.0)), float(analysis.get("flops", 0.0))


def main() -> None:
    """Measure both backends, print the table and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--clouds", type=int, default=BATCH)
    parser.add_argument("--any-device", action="store_true", help="accept a CPU, to try the command")
    options = parser.parse_args()
    device = jax.devices()[0]
    if device.platform == "cpu" and not options.any_device:
        raise SystemExit("error: jax sees no accelerator")
    network = colornet.load_default()
    name, clouds = sample_clouds(options.clouds, N_POINTS)
    packed = jax.device_put(thor2.PointClouds.pack(clouds, N_POINTS), device)
    memory, arithmetic = LIMITS.get(device.device_kind, (None, None))
    print(f"{device.device_kind}: {len(clouds)} clouds of {N_POINTS} points, {name}")
    print(f"{'backend':12s} {'clouds/s':>12s} {'first call s':>13s} {'of memory':>10s} {'of arithmetic':>14s}")
    rows = {}
    for homology in ("closed_form", "gudhi"):
        config = thor2.DescriptorConfig(homology=homology)
        timing = time_calls(lambda c=config: thor2.describe(packed, network, c))
        size, operations = cost(lambda p, c=config: thor2.describe(p, network, c), packed)
        shares = [
            count / timing.median / limit if limit else None
            for count, limit in ((size, memory), (operations, arithmetic))
        ]
        rate = len(clouds) / timing.median
        percentages = [f"{share:.1%}" if share is not None else "unknown" for share in shares]
        print(f"{homology:12s} {rate:12,.0f} {timing.first:13.1f} {percentages[0]:>10s} {percentages[1]:>14s}")
        rows[homology] = {
            "clouds_per_s": rate,
            "first_call_s": timing.first,
            "bytes": size,
            "operations": operations,
            "share_of_memory": shares[0],
            "share_of_arithmetic": shares[1],
        }
    options.out.mkdir(parents=True, exist_ok=True)
    measured = {"device": device.device_kind, "jax": jax.__version__, "clouds": len(clouds), "points": N_POINTS}
    (options.out / "gpu.json").write_text(json.dumps(measured | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
