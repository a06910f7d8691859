"""Does the suite notice faults? Small ones are put into the package, one at a time.

    python tests/mutants.py --count 30 --seed 0 --out mutants.md

So many mutants of each room are drawn at random, whatever other rooms there are; each is tried on
the tests of its module alone, in a copy of the sources. One that no test notices is either a gap in
the tests or does not change what the code promises (a speed-up, a tolerance): read it and say
which. Operators are those of cosmic-ray, which ``make mutants`` installs, and two of our own: a
term that is dropped, a statement that is left out.
"""

from __future__ import annotations

import argparse
import difflib
import math
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

# pyright: reportMissingImports=false
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators import (
    binary_operator_replacement,
    boolean_replacer,
    comparison_operator_replacement,
    number_replacer,
    unary_operator_replacement,
    zero_iteration_for_loop,
)
from cosmic_ray.operators.operator import Operator

ROOT = Path(__file__).resolve().parents[1]

NAMED: dict[str, str] = {
    "fitting/windows": "fitting/windows fitting/from_outputs",
    "fitting/folds": "fitting/folds fitting/from_outputs",
    "data/records": "data/records stream",
    "data/paired_blocks": "data/paired_blocks",
    "engine/held": "engine/held engine/integrators model/model fitting/held_pairs",
    "engine/gauge_directions": "least_squares/gauge model/model",
    "engine/innovation": "fitting/prediction fitting/held_pairs",
    "engine/blocked_kernel": "engine/sensitivity",
    "engine/cell": "engine/cell engine/held model/model",
    "engine/differentiable": "engine/differentiable engine/lfr",
    "engine/kalman_kernel": "model/extended_kalman_filter",
    "engine/record_starts": "engine/initial_state model/model least_squares/problem",
    "engine/weights": "engine/sensitivity engine/simulation least_squares/problem",
    "engine/feedback_recurrence": "engine/feedback_recurrence engine/sensitivity",
    "engine/linear_recurrence": "engine/linear_recurrence engine/newton engine/sensitivity",
    "engine/newton": "engine/newton",
    "engine/simulation": "engine/simulation model/model engine/newton maps/maps",
    "engine/simulation_kernel": "engine/simulation maps/maps",
    "engine/initial_state": "engine/initial_state least_squares/problem",
    "engine/start_kernel": "engine/initial_state",
    "engine/small_matrices": "engine/small_matrices",
    "engine/linearised": "engine/sensitivity engine/simulation",
    "maps/activations": "maps/activations maps/maps maps/linearised",
    "maps/linearised": "maps/linearised engine/sensitivity",
    "maps/network": "maps/linearised maps/maps least_squares/gauge model/model guarantees/bounds",
    "maps/static_map": "maps/new_map maps/linearised maps/maps",
    "engine/jacobian_kernel": "engine/sensitivity least_squares/problem",
    "engine/sensitivity": "engine/sensitivity least_squares/problem",
    "least_squares/held_steps": "least_squares/held_steps fitting/held_pairs least_squares/problem",
    "least_squares/bounded_system": "least_squares/box least_squares/stable_states",
    "least_squares/box": "least_squares/box",
    "least_squares/fit_memory": "least_squares/fit_memory",
    "least_squares/guarantee": "least_squares/box guarantees/contracting",
    "least_squares/options": "least_squares/levenberg_marquardt least_squares/adam",
    "least_squares/output_columns": "least_squares/problem least_squares/held_steps",
    "least_squares/simulation_errors": "least_squares/problem fitting/trainer",
    "least_squares/stable_states": "least_squares/stable_states",
    "least_squares/start_states": "least_squares/start_states least_squares/problem",
    "least_squares/search": "least_squares/search linear/bla fitting/trainer",
    "least_squares/shared_problem": "distributed",
    "least_squares/jacobian": "least_squares/problem least_squares/start_states memory",
    "least_squares/output_rows": "least_squares/problem least_squares/start_states memory",
    "least_squares/linear_systems": "least_squares/linear_systems least_squares/problem devices",
    "least_squares/record_groups": "least_squares/problem",
    "least_squares/gauge": "least_squares/gauge least_squares/problem",
    "least_squares/ridge": "least_squares/problem",
    "least_squares/term": "least_squares/problem",
    "least_squares/problem": "least_squares/problem fitting/trainer",
    "least_squares/levenberg_marquardt": "least_squares/levenberg_marquardt",
    "least_squares/adam": "least_squares/adam",
    "fitting/first_fit": "job fitting/stages",
    "fitting/linear_start": "job fitting/given_entries fitting/stages",
    "fitting/nonlinear_end": "fitting/starts",
    "fitting/trainer": "fitting/trainer fitting/snapshots distributed",
    "fitting/snapshots": "fitting/snapshots",
    "fitting/state_file": "fitting/snapshots",
    "fitting/fit_state": "fitting/snapshots fitting/trainer",
    "fitting/multistart": "fitting/multistart fitting/snapshots fitting/stages distributed",
    "linear/subspace": "linear/subspace linear/bla linear/order_scan",
    "linear/regression": "linear/frf linear/local_polynomial linear/bla",
    "linear/refinement": "linear/bla linear/signal_fit linear/response_fit",
    "linear/response_fit": "linear/response_fit linear/bla linear/order_scan",
    "linear/signal_fit": "linear/signal_fit linear/bla",
    "linear/bla": "linear/bla linear/order_scan linear/integrators",
    "linear/minima": "linear/bla",
    "linear/spectral_data": "linear/response_fit linear/bla linear/order_scan linear/frf",
    "linear/spectra": "linear/spectra linear/frf linear/local_polynomial linear/bla",
    "linear/local_polynomial": "linear/local_polynomial linear/frf linear/bla",
    "linear/frf": "linear/frf linear/bla",
    "files/load": "files/load files/formats",
    "files/text": "files/load",
    "reporting/linear_report": "cli/linear",
    "reporting/survey_plots": "reporting/preview cli/preview",
    "cli/declared": "cli/composition cli/quotes",
    "cli/hydra_versions": "cli/errors",
    "cli/interrupts": "cli/errors cli/fit",
}
"""Modules and their tests."""

ROOMS = {
    "fitting": "fitting/stages fitting/trainer",
    "files": "files/load files/formats",
    "reporting": "reporting/scores reporting/html job",
    "cli": "cli/fit",
}
"""Rooms of which all modules are tried: those that are not named above on the tests of the same
name, or on these if there are none."""


def _of_rooms() -> Iterator[tuple[str, str]]:
    for room, common in ROOMS.items():
        for path in sorted((ROOT / "lfrtorch" / room).glob("[!_]*.py")):
            own = ROOT / "tests" / room / f"test_{path.stem}.py"
            module = f"{room}/{path.stem}"
            yield module, module if own.exists() else common


TESTS = {**dict(_of_rooms()), **NAMED}
"""All modules and their tests."""

TOO_LONG, LEAST = 6.0, 60.0
"""A mutant whose tests still run after so many times those of the clean module, and after so many
seconds, has been noticed: it does not end."""

LIBRARIES = ["torch", "numba", "scipy.signal", "scipy.io", "pandas", "matplotlib"]
"""Imported once, for all mutants."""


class Mutant(NamedTuple):
    """One fault: the occurrence of an operator in a module, whose source is ``clean``."""

    module: str
    clean: str
    line: int
    operator: Operator
    occurrence: int

    @property
    def source(self) -> str:
        """The module's source with the fault."""
        mutated = mutate_code(self.clean, self.operator, self.occurrence)
        assert mutated is not None
        return mutated


class DropTerm(Operator):
    """a + b becomes a, and a * b becomes a."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        """The last term of a sum or product."""
        if node.type in ("arith_expr", "term"):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """Without it."""
        node.children = node.children[:-2]
        return node

    @classmethod
    def examples(cls) -> tuple[()]:
        """None."""
        return ()


class DropStatement(Operator):
    """A call, or an assignment to what exists already, becomes ``pass``."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        """Where one stands."""
        if node.type == "simple_stmt" and self._is_left_out(node.children[0]):
            yield node.start_pos, node.end_pos

    def _is_left_out(self, statement: Any) -> bool:
        if statement.type == "atom_expr":
            return True
        if statement.type != "expr_stmt":
            return False
        target, operator = statement.children[0], statement.children[1]
        augmented = operator.type == "operator" and operator.value != "="
        return augmented or (operator.type == "operator" and target.type == "atom_expr")

    def mutate(self, node: Any, index: int) -> Any:
        """``pass`` in its place."""
        first = node.get_first_leaf()
        node.children[0] = type(first)("pass", first.start_pos, prefix=first.prefix)
        return node

    @classmethod
    def examples(cls) -> tuple[()]:
        """None."""
        return ()


def operators() -> list[Operator]:
    """Faults that someone might make; no shifts of floats, which any test notices."""
    arithmetic = (
        "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Div FloorDiv_Mul Mod_FloorDiv Pow_Mul "
        "BitAnd_BitOr BitOr_BitAnd"
    )
    comparisons = (
        "Lt_LtE LtE_Lt Gt_GtE GtE_Gt Lt_Gt Gt_Lt LtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is"
    )
    unary = "USub_Nothing Not_Nothing Invert_Nothing"
    found = [
        *(
            getattr(binary_operator_replacement, f"ReplaceBinaryOperator_{name}")
            for name in arithmetic.split()
        ),
        *(
            getattr(comparison_operator_replacement, f"ReplaceComparisonOperator_{name}")
            for name in comparisons.split()
        ),
        *(
            each
            for each in unary_operator_replacement.operators()
            if each.__name__.endswith(tuple(unary.split()))
        ),
        boolean_replacer.AddNot,
        boolean_replacer.ReplaceTrueWithFalse,
        boolean_replacer.ReplaceFalseWithTrue,
        boolean_replacer.ReplaceAndWithOr,
        boolean_replacer.ReplaceOrWithAnd,
        number_replacer.NumberReplacer,
        zero_iteration_for_loop.ZeroIterationForLoop,
        DropTerm,
        DropStatement,
    ]
    return [operator() for operator in found]


def mutants(module: str) -> Iterator[Mutant]:
    """All of a module, but for those in annotations, assertions, messages and decorators."""
    clean = (ROOT / "lfrtorch" / f"{module}.py").read_text()
    tree = get_ast(clean)
    for operator in operators():
        positions = (node for node in ast_nodes(tree) for _ in operator.mutation_positions(node))
        for occurrence, node in enumerate(positions):
            if not _is_outside(node):
                yield Mutant(module, clean, node.start_pos[0], operator, occurrence)


def _is_outside(node: Any) -> bool:
    """Whether a node has no effect on what is computed."""
    below = None
    while node is not None:
        if node.type in ("annassign", "tfpdef", "decorator", "assert_stmt", "raise_stmt"):
            return not (node.type == "annassign" and below is node.children[-1])
        if node.type in ("fstring", "import_from"):
            return True
        if node.type == "funcdef" and below is not None and below is node.annotation:
            return True
        below, node = node, node.parent
    return False


def drawn_from(modules: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """So many mutants of each room; those of a room do not depend on the others."""
    found: list[Mutant] = []
    for room in sorted({module.split("/")[0] for module in modules}):
        own = [m for each in modules if each.startswith(f"{room}/") for m in mutants(each)]
        found += random.Random(f"{seed} {room}").sample(own, min(count, len(own)))
    return found


def _run(folder: Path, tests: str) -> None:
    """In a process of its own: the exit code is that of pytest."""
    import pytest

    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(folder)
    sys.path[:0] = [str(folder)]
    names = (Path(name) for name in tests.split())
    files = [str(Path("tests", name.parent, f"test_{name.name}.py")) for name in names]
    os._exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-n", "0", *files]))


def clean_seconds(tests: str, folder: Path, processes: Any) -> float:
    """How long some tests take without a fault; infinite if they fail."""
    begun = time.monotonic()
    process = processes.Process(target=_run, args=(folder, tests))
    process.start()
    process.join()
    return math.inf if process.exitcode else time.monotonic() - begun


def is_noticed(mutant: Mutant, folder: Path, processes: Any, limit: float) -> bool:
    """Whether the tests of the module fail on the mutant, or take longer than so many seconds."""
    module = mutant.module
    path, kept = folder / "lfrtorch" / f"{module}.py", folder / "kept.py"
    shutil.copy2(path, kept)
    path.write_text(mutant.source)
    process = processes.Process(target=_run, args=(folder, TESTS[module]))
    process.start()
    process.join(limit)
    if late := process.is_alive():
        process.kill()
        process.join()
    shutil.copy2(kept, path)  # as old as it was, so that compiled code is good again
    for file in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        file.unlink()
    kernels = (ROOT / "lfrtorch" / f"{module}.py").parent / "__pycache__"
    for file in kernels.glob(f"{path.stem}.*"):  # compiled already
        shutil.copy2(file, path.parent / "__pycache__")
    return late or process.exitcode != 0


def difference(mutant: Mutant) -> str:
    """The lines that the mutant changes."""
    lines = difflib.unified_diff(
        mutant.clean.splitlines(), mutant.source.splitlines(), n=0, lineterm=""
    )
    return "\n".join(line for line in lines if line[:3] not in ("---", "+++"))


def main() -> int:
    """Draw, try and list them."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--count", type=int, default=30, help="mutants of each room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--modules", nargs="+", choices=sorted(TESTS), default=sorted(TESTS))
    parser.add_argument("--only", nargs="+", type=int, help="numbers of the draw to try again")
    parser.add_argument("--out", type=Path, default=Path("mutants.md"))
    given = parser.parse_args()

    drawn = drawn_from(given.modules, given.count, given.seed)
    numbers = range(len(drawn)) if given.only is None else given.only
    print(f"{len(numbers)} mutants in {len(given.modules)} modules", flush=True)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(LIBRARIES)
    begun, noticed = time.monotonic(), 0
    with tempfile.TemporaryDirectory() as top, given.out.open("w") as out:
        folders: SimpleQueue[Path] = SimpleQueue()
        for job in range(given.jobs):
            folder = Path(top) / str(job)
            ignored = shutil.ignore_patterns(".venv", ".git", "runs", "results")
            shutil.copytree(ROOT, folder, ignore=ignored)
            folders.put(folder)

        seconds: dict[str, float] = {}

        def tried(task: Mutant | str) -> bool:
            folder = folders.get()
            try:
                if isinstance(task, str):
                    seconds[task] = clean_seconds(task, folder, processes)
                    return math.isfinite(seconds[task])
                limit = max(LEAST, TOO_LONG * seconds[TESTS[task.module]])
                return is_noticed(task, folder, processes, limit)
            finally:
                folders.put(folder)

        with ThreadPoolExecutor(given.jobs) as pool:
            used = sorted({TESTS[drawn[i].module] for i in numbers})
            sound = list(pool.map(tried, used))
            for tests, passed in zip(used, sound, strict=True):
                print(f"{tests}: {seconds[tests]:.0f} s", flush=True)
                if not passed:
                    print(f"{tests}: they fail without a fault: mend them first")
            if not all(sound):
                return 2
            found = pool.map(tried, [drawn[i] for i in numbers])
            for number, caught in zip(numbers, found, strict=True):
                noticed += caught
                mutant = drawn[number]
                if not caught:
                    name = f"{number}: lfrtorch/{mutant.module}.py, line {mutant.line}"
                    out.write(f"## {name}\n\n```diff\n{difference(mutant)}\n```\n\n")
                    out.flush()
                state = "noticed" if caught else "NOT noticed"
                print(
                    f"{number} {mutant.module} {state} {time.monotonic() - begun:.0f} s", flush=True
                )
    print(f"{noticed} of {len(numbers)} noticed; those that were not are in {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
