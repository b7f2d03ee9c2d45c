"""Mutation testing: small changes to the sources, one at a time, each of which should make a test fail.

    python tests/mutation.py --results mutants.jsonl --sample 10     # ten mutants for each module; resumes
    python tests/mutation.py --results mutants.jsonl --sample 0      # counts and survivors of the results so far

Requires the extra `mutation`. The checkout is not changed: mutants are tested in a copy in a temporary folder, each in
its own process. Cosmic Ray generates them. A place in the source is drawn first and one of its mutants second, so that
operators with many replacements have no larger share. Annotations are excluded, because they have no effect at run
time, and so are replacements between families of operators (+ by <<), which are nearly always type errors.

Of ten mutants for each module (seed 0), an earlier version of the tests killed 248 of 271. Those that survived are
equal to the original: no `jax.jit` or another cache size (the same values, more slowly), `strict=False` for lists of
equal length, bounds that no value reaches (`>=` for `==` on names of devices, `row != height - 1`, 81 for an exponent
of 80, indices JAX clips), another `DESCRIPTOR_VERSION`, and searches whose results are filtered or compared again
(the ball of `builder.py`, one rectangle fewer in `view_normalization.py`, its halving loop).
"""

import argparse
import ast
import difflib
import functools
import hashlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import use_mutation
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parents[1]

ROOMS = "adaptation descriptor frames gallery model networks segmentation surfaces tracking".split()
FOLDERS = ("colornet", "thor2_jax", *(f"thor2_jax/{room}" for room in ROOMS))
"""Directories whose modules are mutated."""

MORE_TESTS = {
    "colornet/network.py": ["tests/colornet/test_files.py", "tests/colornet/test_colors.py"],
    "thor2_jax/types.py": ["tests/thor2_jax/test_types.py"],
}
"""Module -> test files that do not import it by its name."""


def tests_of(module: str) -> list[str]:
    """Return the test files of a module: test_MODULE.py, what imports it in its folder or the properties, and more."""
    path = Path(module)
    name = ".".join(path.with_suffix("").parts)
    imports = re.compile(rf"^from {re.escape(name)} import ", re.MULTILINE)
    files = [file for folder in (path.parent, "properties") for file in (ROOT / "tests" / folder).glob("test_*.py")]
    chosen = [file for file in sorted(files) if file.name == f"test_{path.name}" or imports.search(file.read_text())]
    return [str(file.relative_to(ROOT)) for file in chosen] + MORE_TESTS.get(module, [])


MODULES = [f"{folder}/{path.name}" for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.py"))]
TESTS = {module: tests for module in MODULES if (tests := tests_of(module))}
"""Module -> its test files."""

FAMILIES = ({"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}, {"RShift", "LShift"}, {"BitOr", "BitAnd", "BitXor"})
"""Families of binary operators."""


class Mutant(NamedTuple):
    """A change of a module: the occurrence with this number, counted through the file, of an operator of Cosmic Ray."""

    module: str
    source: str  # digest of the module's source
    operator: str
    occurrence: int
    line: int


def digest_of(module: str) -> str:
    return hashlib.sha256((ROOT / module).read_bytes()).hexdigest()[:12]


def within_a_family(operator: str) -> bool:
    kind, *parts = operator.rpartition("/")[2].split("_")
    if kind == "ReplaceBinaryOperator":
        return any({*parts} <= family for family in FAMILIES)
    return not (kind == "ReplaceComparisonOperator" and {"Is", "IsNot"} & {*parts})


def mutants_by_place(module: str) -> list[list[Mutant]]:
    """Return all mutants of a module, grouped by their place in the source, in source order, without annotations."""
    source, digest = (ROOT / module).read_text(), digest_of(module)
    tree = get_ast(source)
    nodes = [getattr(node, name, None) for node in ast.walk(ast.parse(source)) for name in ("annotation", "returns")]
    excluded = [((n.lineno, n.col_offset), (n.end_lineno, n.end_col_offset)) for n in nodes if n is not None]
    places: dict[Any, list[Mutant]] = defaultdict(list)
    for name in sorted(filter(within_a_family, operator_names())):
        operator = get_operator(name)
        if operator.arguments():
            continue
        positions = (place for node in ast_nodes(tree) for place in operator().mutation_positions(node))
        for occurrence, (start, end) in enumerate(positions):
            if not any(first <= start and end <= last for first, last in excluded):
                places[start, end].append(Mutant(module, digest, name, occurrence, start[0]))
    return [places[place] for place in sorted(places)]


def draw_mutants(module: str, sample: int | None, seed: int) -> list[Mutant]:
    """Draw mutants of a module, at most one for each place; all mutants if `sample` is None. Samples are nested."""
    places = mutants_by_place(module)
    if sample is None:
        return [mutant for place in places for mutant in place]
    rng = random.Random(f"{seed} {module}")
    rng.shuffle(places)
    return [rng.choice(place) for place in places[:sample]]


def test(tree: Path, module: str, limit: float | None = None) -> str:
    """Run the tests of a module in a copy of the checkout; return "killed", "survived" or "timeout"."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *TESTS[module]]
    # A mutant can have the size and time stamp of the previous one. The tests share compiled programs.
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:  # what the tests start ends with them, see tests/conftest.py
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return "timeout"
    return "killed" if done.returncode else "survived"


@functools.cache
def time_limit(tree: Path, module: str) -> float:
    """Return the time limit for a mutant of the module in seconds; its tests must pass without a mutant."""
    start = time.monotonic()
    if test(tree, module) != "survived":
        sys.exit(f"{module}: its tests fail without a mutant: {' '.join(TESTS[module])}")
    return 3 * (time.monotonic() - start) + 30


def run_mutant(tree: Path, mutant: Mutant) -> dict[str, Any]:
    """Test a mutant and return its record for the results file."""
    path, limit = tree / mutant.module, time_limit(tree, mutant.module)
    with use_mutation(path, get_operator(mutant.operator)(), mutant.occurrence) as (source, changed):
        outcome = test(tree, mutant.module, limit)
    diff = list(difflib.unified_diff(source.splitlines(), changed.splitlines(), n=0, lineterm=""))[3:]
    return {**mutant._asdict(), "outcome": outcome, "diff": diff}


def main() -> None:
    parser = argparse.ArgumentParser(description="Mutation testing; see the docstring of this file.")
    parser.add_argument("modules", nargs="*", metavar="MODULE", help="such as colornet/colors.py; default: all")
    parser.add_argument("--results", type=Path, required=True, help="JSON lines, one for each mutant; resumes")
    parser.add_argument("--sample", type=int, help="number of mutants for each module; default: all")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    modules = options.modules or list(TESTS)
    if unknown := set(modules) - set(TESTS):
        parser.error(f"MODULE is {', '.join(sorted(unknown))}; expected a module that has tests")

    options.results.touch()
    records = [json.loads(line) for line in options.results.read_text().splitlines()]
    results = {Mutant(*(record[name] for name in Mutant._fields)): record for record in records}
    results = {mutant: record for mutant, record in results.items() if mutant.source == digest_of(mutant.module)}
    todo = [m for name in modules for m in draw_mutants(name, options.sample, options.seed) if m not in results]
    with tempfile.TemporaryDirectory() as folder, open(options.results, "a") as stream:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".*", "__pycache__"))
        if (ROOT.parent / "shared").is_dir():
            (Path(folder) / "shared").symlink_to(ROOT.parent / "shared")
        for k, mutant in enumerate(todo, 1):
            results[mutant] = run_mutant(tree, mutant)
            print(json.dumps(results[mutant]), file=stream, flush=True)
            print(f"{k}/{len(todo)} {mutant.module}:{mutant.line} {results[mutant]['outcome']}", flush=True)
    for mutant, record in results.items():
        if record["outcome"] == "survived":
            print(f"\n{mutant.module}:{mutant.line} {mutant.operator} {mutant.occurrence}", *record["diff"], sep="\n")
    print(dict(Counter(record["outcome"] for record in results.values())))


if __name__ == "__main__":
    main()
