"""Mutation testing: small changes to the sources, one at a time, each of which a test must notice.

    python tests/mutation.py --results mutants.jsonl --sample 10     # ten mutants a module; goes on where it was ended
    python tests/mutation.py --results mutants.jsonl --survivors     # those that survived, once tests have been added
    python tests/mutation.py --results mutants.jsonl --sample 0      # table and survivors of what has been run

Needs the extra `mutation`. The checkout stays as it is: mutants live in a copy in a temporary folder, one process each.
Cosmic Ray makes them; a place in the source is drawn first, one of its mutants second, so that an operator with many
replacements counts no more than a number. Left out are places within annotations, which do nothing at run time, and
replacements from one family of operators by another (+ by <<), nearly all of which are type errors.
"""

import argparse
import ast
import dataclasses
import difflib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parents[1]

TESTS = {
    "colornet/__init__.py": ("colornet/test_files.py", "colornet/test_build.py"),
    "colornet/builder.py": ("colornet/test_build.py",),
    "colornet/files.py": ("colornet/test_files.py",),
    "colornet/grid.py": ("colornet/test_color_math.py", "colornet/test_membership.py"),
    "colornet/lab.py": ("colornet/test_color_math.py", "colornet/test_build.py"),
    "colornet/mapper.py": ("colornet/test_color_math.py", "colornet/test_build.py"),
    "colornet/network.py": ("colornet/test_files.py", "colornet/test_membership.py"),
    "colornet/regions.py": ("colornet/test_regions.py", "colornet/test_build.py"),
    "thor2_jax/descriptor/bounding_box.py": (
        "thor2_jax/descriptor/test_bounding_box.py",
        "thor2_jax/descriptor/test_view_normalization.py",
    ),
    "thor2_jax/capacity.py": ("thor2_jax/test_capacity.py",),
    "thor2_jax/recognition/classifier.py": ("thor2_jax/recognition/test_classifier.py",),
    "thor2_jax/descriptor/color_membership.py": (
        "thor2_jax/descriptor/test_color_membership.py",
        "thor2_jax/test_types.py",
    ),
    "thor2_jax/config.py": ("thor2_jax/test_config.py",),
    "thor2_jax/descriptor/describe.py": ("thor2_jax/descriptor/test_describe.py",),
    "thor2_jax/recognition/frames.py": ("thor2_jax/recognition/test_frames.py", "thor2_jax/test_types.py"),
    "thor2_jax/recognition/instance_clouds.py": (
        "thor2_jax/recognition/test_instance_clouds.py",
        "thor2_jax/test_types.py",
    ),
    "thor2_jax/recognition/occlusion.py": ("thor2_jax/recognition/test_occlusion.py", "thor2_jax/test_types.py"),
    "thor2_jax/recognition/outlier_removal.py": (
        "thor2_jax/recognition/test_outlier_removal.py",
        "thor2_jax/recognition/test_instance_clouds.py",
    ),
    "thor2_jax/parameters.py": ("thor2_jax/test_types.py", "properties/test_reproducibility.py"),
    "thor2_jax/descriptor/persistence.py": ("thor2_jax/descriptor/test_persistence.py",),
    "thor2_jax/descriptor/persistence_images.py": ("thor2_jax/descriptor/test_persistence_images.py",),
    "thor2_jax/descriptor/reductions.py": ("thor2_jax/descriptor/test_reductions.py",),
    "thor2_jax/descriptor/relaxation.py": ("properties/test_relaxation.py",),
    "thor2_jax/descriptor/slicing.py": ("thor2_jax/descriptor/test_slicing.py",),
    "thor2_jax/types.py": ("thor2_jax/test_types.py", "thor2_jax/descriptor/test_persistence.py"),
    "thor2_jax/descriptor/view_normalization.py": ("thor2_jax/descriptor/test_view_normalization.py",),
    "thor2_jax/recognition/voxel_grid.py": ("thor2_jax/recognition/test_voxel_grid.py",),
}
"""The tests, below tests/, that hold a module to account: the quickest first."""

FAMILIES = ({"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}, {"RShift", "LShift"}, {"BitOr", "BitAnd", "BitXor"})
"""Of binary operators."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """The `occurrence`-th change that an operator of Cosmic Ray makes to a module, counted through the file."""

    module: str
    source: str  # digest of the module
    operator: str
    occurrence: int
    line: int


def within_a_family(operator: str) -> bool:
    parts = operator.rpartition("/")[2].split("_")
    if parts[0] == "ReplaceBinaryOperator":
        return any({*parts[1:]} <= family for family in FAMILIES)
    return not (parts[0] == "ReplaceComparisonOperator" and {"Is", "IsNot"} & {*parts[1:]})


def annotations(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """First and last (line, column) of every annotation."""
    nodes = [
        annotation
        for node in ast.walk(ast.parse(source))
        for annotation in (getattr(node, "annotation", None), getattr(node, "returns", None))
        if annotation is not None
    ]
    return [((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0)) for node in nodes]


def mutants_by_place(module: str) -> list[list[Mutant]]:
    """All mutants of a module, those of one place in the source together, in the order of the source."""
    source = (ROOT / module).read_text()
    digest = hashlib.sha256(source.encode()).hexdigest()[:12]
    left_out, tree = annotations(source), get_ast(source)
    places: dict[tuple[tuple[int, int], tuple[int, int]], list[Mutant]] = defaultdict(list)
    for name in sorted(filter(within_a_family, operator_names())):
        operator = get_operator(name)
        if operator.arguments():
            continue
        positions = (place for node in ast_nodes(tree) for place in operator().mutation_positions(node))
        for occurrence, (start, end) in enumerate(positions):
            if not any(first <= start and end <= last for first, last in left_out):
                places[start, end].append(Mutant(module, digest, name, occurrence, start[0]))
    return [places[place] for place in sorted(places)]


def drawn(module: str, sample: int | None, seed: int) -> list[Mutant]:
    """A sample of a module's mutants, one a place; all of them if `sample` is None. A larger sample holds a smaller."""
    places = mutants_by_place(module)
    if sample is None:
        return [mutant for place in places for mutant in place]
    rng = random.Random(f"{seed} {module}")
    rng.shuffle(places)
    return [rng.choice(place) for place in places[:sample]]


class Sandbox:
    """A copy of the checkout in which tests run."""

    def __init__(self, folder: Path) -> None:
        self.tree = folder / "tree"
        shutil.copytree(ROOT, self.tree, ignore=shutil.ignore_patterns(".*", "__pycache__"))
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(self.tree),
            "PYTHONDONTWRITEBYTECODE": "1",  # a mutant may be as long and as old as the one before
            "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),  # three times as fast
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        self._limits: dict[str, float] = {}

    def test(self, module: str, limit: float | None = None) -> tuple[str, float]:
        """Run a module's tests: killed, survived or timeout, and the seconds that it took."""
        options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow"]
        command = [sys.executable, "-m", "pytest", *options, *(f"tests/{name}" for name in TESTS[module])]
        start = time.monotonic()
        with open(self.tree.with_name("output.txt"), "w") as output:
            child = subprocess.Popen(
                command, cwd=self.tree, env=self.environment, stdout=output, stderr=output, start_new_session=True
            )
            try:
                outcome = "killed" if child.wait(limit) else "survived"
            except subprocess.TimeoutExpired:
                outcome = "timeout"
            finally:
                if child.poll() is None:
                    os.killpg(child.pid, signal.SIGKILL)
                    child.wait()
        return outcome, time.monotonic() - start

    def limit(self, module: str) -> float:
        """Seconds after which a mutant of the module counts as hanging; its tests must pass without a mutant."""
        if module not in self._limits:
            outcome, seconds = self.test(module)
            if outcome != "survived":
                sys.exit(f"{module}: its tests fail without a mutant\n{self.tree.with_name('output.txt').read_text()}")
            self._limits[module] = 3 * seconds + 30
        return self._limits[module]

    def run(self, mutant: Mutant) -> dict[str, Any]:
        """What becomes of a mutant, as a record for the file of results."""
        path, limit = self.tree / mutant.module, self.limit(mutant.module)
        source = path.read_text()
        changed = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
        try:
            path.write_text(changed)
            outcome, seconds = self.test(mutant.module, limit)
        finally:
            path.write_text(source)
        diff = list(difflib.unified_diff(source.splitlines(), changed.splitlines(), n=0, lineterm=""))[3:]
        return {**dataclasses.asdict(mutant), "outcome": outcome, "seconds": round(seconds, 1), "diff": diff}


def read_results(path: Path) -> dict[Mutant, dict[str, Any]]:
    """The last record of each mutant of the sources as they are now."""
    digests = {module: hashlib.sha256((ROOT / module).read_bytes()).hexdigest()[:12] for module in TESTS}
    fields = [field.name for field in dataclasses.fields(Mutant)]
    records = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return {
        Mutant(*(record[name] for name in fields)): record
        for record in records
        if digests.get(record["module"]) == record["source"]
    }


def print_report(results: dict[Mutant, dict[str, Any]]) -> None:
    """The table by module, and the survivors with what was changed."""
    outcomes = ("killed", "survived", "timeout")
    rows = {module: [r["outcome"] for r in results.values() if r["module"] == module] for module in TESTS}
    rows["all"] = [record["outcome"] for record in results.values()]
    print("\n| module | mutants | killed | survived | timed out |\n|---|--:|--:|--:|--:|")
    for module, found in rows.items():
        print(f"| {module} | {len(found)} | {' | '.join(str(found.count(name)) for name in outcomes)} |")
    noticed = len(rows["all"]) - rows["all"].count("survived")
    print(f"\nkilled or timed out: {noticed / max(len(rows['all']), 1):.1%}")
    for mutant, record in results.items():
        if record["outcome"] == "survived":
            print(f"\n{mutant.module}:{mutant.line} {mutant.operator} {mutant.occurrence}", *record["diff"], sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description="Mutation testing; see the head of this file.")
    parser.add_argument(
        "modules", nargs="*", metavar="MODULE", help="as thor2_jax/descriptor/slicing.py; by default all"
    )
    parser.add_argument(
        "--results", type=Path, required=True, help="one JSON line a mutant; what it has is not run again"
    )
    parser.add_argument("--sample", type=int, help="mutants a module; by default all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--survivors", action="store_true", help="run those again that survived, and no others")
    options = parser.parse_args()
    modules = options.modules or list(TESTS)
    if unknown := set(modules) - set(TESTS):
        parser.error(f"no tests are known for {', '.join(sorted(unknown))}")

    results = read_results(options.results)
    if options.survivors:
        todo = [m for m, record in results.items() if record["outcome"] == "survived" and m.module in modules]
    else:
        todo = [m for name in modules for m in drawn(name, options.sample, options.seed) if m not in results]
    with tempfile.TemporaryDirectory() as folder:
        sandbox = Sandbox(Path(folder))
        for k, mutant in enumerate(todo, 1):
            record = sandbox.run(mutant)
            results[mutant] = record
            with open(options.results, "a") as stream:
                print(json.dumps(record), file=stream)
            print(
                f"{k}/{len(todo)} {mutant.module}:{mutant.line} {record['outcome']} {record['seconds']} s", flush=True
            )
    print_report(results)


if __name__ == "__main__":
    main()
