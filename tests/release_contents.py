"""Check what the wheel and the sdist in a directory contain: python tests/release_contents.py DIST."""

import sys
import tarfile
import zipfile
from pathlib import Path

PACKAGES = ("colornet", "thor2_jax", "training")
REQUIRED = (
    *(f"{package}/py.typed" for package in PACKAGES),
    "colornet/data/network.npz",
    "thor2_jax/service/page/samples/index.json",
    "thor2_jax/service/page/samples/breakfast/depth.png",
)
MAX_BYTES = 12e6


def check(directory: Path) -> None:
    """Raise SystemExit unless the two archives have what users need and nothing else."""
    (wheel,), (sdist,) = directory.glob("*.whl"), directory.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = set(archive.namelist())
    with tarfile.open(sdist) as content:
        in_sdist = {name.partition("/")[2] for name in content.getnames()}
    problems = [f"{wheel.name} lacks {name}" for name in REQUIRED if name not in in_wheel]
    problems += [f"{sdist.name} lacks {name}" for name in (*REQUIRED, "LICENSE", "README.md") if name not in in_sdist]
    allowed = tuple(f"{package}/" for package in PACKAGES)
    problems += [f"{wheel.name} has {n}" for n in in_wheel if not n.startswith(allowed) and ".dist-info/" not in n]
    problems += [f"{wheel.name} has {name}" for name in in_wheel if name.endswith((".pyc", ".orig", ".rej"))]
    large = [path for path in (wheel, sdist) if path.stat().st_size > MAX_BYTES]
    problems += [f"{path.name} has {path.stat().st_size:,} bytes, more than {MAX_BYTES:,.0f}" for path in large]
    if problems:
        raise SystemExit("\n".join(problems))
    for path, names in ((wheel, in_wheel), (sdist, in_sdist)):
        print(f"{path.name}: {len(names)} files, {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    check(Path(sys.argv[1]))
