"""Clouds a second on an accelerator, and the share of its limits that is reached: `python -m benchmarks.run_gpu`.

Prints one table and writes gpu.json with the device's name. XLA's cost analysis counts bytes and operations of the
compiled functions; the limits are those of the device, from a table below.
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

LIMITS = {"NVIDIA H200": (4.8e12, 67e12)}
"""Device -> bytes a second of its memory, float32 operations a second outside tensor cores (the maker's data sheet)."""

BATCH, N_POINTS = 4096, 2048


def cost(function: Any, *arguments: Any) -> tuple[float, float]:
    """Bytes and operations of one call, counted by XLA; a gudhi callback is not in them."""
    found = jax.jit(function).lower(*arguments).compile().cost_analysis() or {}
    return float(found.get("bytes accessed", 0.0)), float(found.get("flops", 0.0))


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--clouds", type=int, default=BATCH)
    parser.add_argument("--any-device", action="store_true", help="a CPU too, to try the command")
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
        told = [f"{share:.1%}" if share is not None else "unknown" for share in shares]
        print(f"{homology:12s} {rate:12,.0f} {timing.first:13.1f} {told[0]:>10s} {told[1]:>14s}")
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
