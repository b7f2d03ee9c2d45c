"""Load test of the service over loopback: `python -m benchmarks.run_service [--out FILE] [--soak N]`.

Frames of six objects are recognized in a plain loop without the service, and then sent to it: by callers that wait for
each answer, at fixed rates (latency counts from the due time), and at twice the highest rate with a 99th percentile
below 250 ms. Other options are passed to `thor2 serve`.
"""

import argparse
import asyncio
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import thor2_jax as thor2
from benchmarks.clouds import make_frames, random_run
from thor2_jax.client import multipart
from thor2_jax.frames.frames import encode_image
from thor2_jax.model.run_directory import save_run
from thor2_jax.service.decoding import decode_frame

LIMIT_MS = 250.0
RATES = (30, 35, 40, 45, 50)

Files = dict[str, bytes]


def files_of(frame: thor2.RGBDFrame) -> Files:
    """Return a frame as the bytes of its files."""
    camera = {name: getattr(frame.intrinsics, name) for name in ("fx", "fy", "cx", "cy", "depth_scale")}
    images = {"color": frame.color, "depth": frame.depth, "labels": frame.label_image.astype(np.uint8)}
    return {name: encode_image(image) for name, image in images.items()} | {"intrinsics": json.dumps(camera).encode()}


def percentiles(milliseconds: list[float]) -> dict[str, float]:
    return {f"p{p}_ms": round(float(np.percentile(milliseconds, p)), 1) if milliseconds else 0.0 for p in (50, 99)}


def plain_loop(run: Path, frames: list[Files], calls: int) -> dict[str, float]:
    """Decode and recognize one frame after another in this process."""
    recognizer, times = thor2.Recognizer.load(run), []
    for files in itertools.islice(itertools.cycle(frames), len(frames) + calls):
        start = time.perf_counter()
        recognizer.recognize(decode_frame(**files))
        times.append((time.perf_counter() - start) * 1e3)
    times = times[len(frames) :]  # the first calls compile
    return {"frames_per_s": round(1e3 * calls / sum(times), 1), **percentiles(times)}


class Server:
    """A process of `thor2 serve` on a free port."""

    def __init__(self, run: Path, *options: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        command = [sys.executable, "-m", "training.cli", "serve", "--model", str(run), "--port", str(self.port)]
        self.process = subprocess.Popen([*command, *options])
        start = time.monotonic()
        while time.monotonic() - start < 300:
            time.sleep(0.2)
            try:
                self.get("/readyz")
                break
            except OSError:
                if self.process.poll() is not None:
                    raise RuntimeError("the server exited before it was ready") from None
        self.ready_after = time.monotonic() - start

    def get(self, path: str) -> str:
        """Return the text at a path."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=10) as answer:
            return answer.read().decode()

    def memory(self) -> float:
        """Return the memory of the server and its subprocesses in MiB, counting shared pages once (PSS)."""
        total, waiting = 0, [self.process.pid]
        while waiting:
            pid = waiting.pop()
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += map(int, (task / "children").read_text().split())
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        return round(total / 1024, 1)

    def stop(self) -> None:
        """Terminate the server and wait until it has exited."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60)


async def request_status(port: int, request: bytes) -> int:
    """Return the status of one request on a new connection, 0 if the answer is incomplete."""
    try:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
        await reader.readexactly(length)
        writer.close()
        return int(head.split()[1])
    except (OSError, EOFError):
        return 0


async def closed_loop(port: int, requests: list[bytes], count: int, at_once: int) -> dict[str, Any]:
    """Measure requests from `at_once` callers that wait for each answer before the next request."""
    times, statuses, numbers = [], Counter[int](), iter(range(count))

    async def caller() -> None:
        for k in numbers:
            start = time.perf_counter()
            statuses[await request_status(port, requests[k % len(requests)])] += 1
            times.append((time.perf_counter() - start) * 1e3)

    start = time.perf_counter()
    await asyncio.gather(*(caller() for _ in range(at_once)))
    rate = count / (time.perf_counter() - start)
    return {"callers": at_once, "frames_per_s": round(rate, 1), **percentiles(times), "statuses": dict(statuses)}


async def open_loop(port: int, requests: list[bytes], rate: float, seconds: float) -> dict[str, Any]:
    """Measure requests at a fixed rate that does not depend on the answers."""
    accepted, statuses = [], Counter[int]()

    async def one(k: int, due: float) -> None:
        await asyncio.sleep(due - time.perf_counter())
        status = await request_status(port, requests[k % len(requests)])
        statuses[status] += 1
        if status == 200:
            accepted.append((time.perf_counter() - due) * 1e3)

    start = time.perf_counter() + 0.1
    await asyncio.gather(*(one(k, start + k / rate) for k in range(int(rate * seconds))))
    elapsed = time.perf_counter() - start
    return {
        "rate": rate,
        "answered_per_s": round(len(accepted) / elapsed, 1),
        **percentiles(accepted),
        "statuses": dict(statuses),
    }


def sustained(result: dict[str, Any]) -> bool:
    return set(result["statuses"]) == {200} and result["p99_ms"] < LIMIT_MS


def main() -> None:
    """Measure the service, print the figures and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--seconds", type=float, default=4.0, help="duration of each rate")
    parser.add_argument("--rates", type=float, nargs="+", default=RATES)
    parser.add_argument(
        "--soak", type=int, default=0, help="instead, measure the memory during this many frames of one object"
    )
    options, serve_options = parser.parse_known_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # exit through `finally`, which stops the server
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        save_run(random_run(), run)  # accuracy does not matter here
        n_objects = 1 if options.soak else 6
        frames = [files_of(frame) for frame in itertools.islice(make_frames(n_objects), 8)]
        result: dict[str, Any] = {"cores": os.cpu_count(), "objects": n_objects, "serve_options": serve_options}
        requests = [multipart_request(files) for files in frames]
        if not options.soak:
            result["plain_loop"] = plain_loop(run, frames, 60)
            print("plain loop", result["plain_loop"])
        server = Server(run, *serve_options)
        try:
            print(f"ready after {server.ready_after:.1f} s")
            asyncio.run(closed_loop(server.port, requests, 32, 4))
            if options.soak:
                result["soak"] = soak(server, requests, options.soak)
            else:
                result |= measure(server, requests, options.rates, options.seconds)
            compiled = server.get("/metrics").split("\nthor2_compilations_after_warm_up_total ")[1].split()[0]
            result["compilations_after_warm_up"] = float(compiled)
            print(f"compilations after warm-up: {compiled}")
        finally:
            server.stop()
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


def multipart_request(files: Files) -> bytes:
    kind, body = multipart(files)
    head = f"POST /v1/recognize HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\nContent-Type: {kind}\r\n"
    return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


def measure(server: Server, requests: list[bytes], rates: list[float], seconds: float) -> dict[str, Any]:
    result: dict[str, Any] = {"service": [], "rates": []}
    for at_once in (1, 8):
        result["service"].append(asyncio.run(closed_loop(server.port, requests, 100, at_once)))
        print("service", result["service"][-1])
    for rate in rates:
        result["rates"].append(asyncio.run(open_loop(server.port, requests, rate, seconds)))
        print("rate", result["rates"][-1])
        if not sustained(result["rates"][-1]):
            break
    highest = max((row["rate"] for row in result["rates"] if sustained(row)), default=rates[0])
    result["sustained_rate"] = highest
    result["twice"] = asyncio.run(open_loop(server.port, requests, 2 * highest, seconds))
    print("twice", result["twice"])
    return result


def soak(server: Server, requests: list[bytes], count: int) -> dict[str, Any]:
    before, memory, statuses = server.memory(), [], Counter[int]()
    print(f"0 requests: {before} MiB")
    for done in range(0, count, count // 10):
        load = asyncio.run(closed_loop(server.port, requests, count // 10, 8))
        statuses.update(load["statuses"])
        memory.append(server.memory())
        print(f"{done + count // 10} requests: {memory[-1]} MiB, {load['frames_per_s']} frames/s")
    return {"requests": count, "statuses": dict(statuses), "mib_before": before, "mib": memory}


if __name__ == "__main__":
    main()
