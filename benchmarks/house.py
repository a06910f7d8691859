"""Size and coupling of a checkout in numbers: lines, paths, importers, settings, edits.

    python benchmarks/house.py [CHECKOUT [AFTER]]

prints a Markdown table of this checkout, of another one, or of two side by side. Each is measured
in processes of its own that import the package from there.

- Lines: physical lines of Python files. A docstring's lines count as docstring, a line that holds
  nothing but a comment as comment.
- A path: the files of the package whose functions run. Compiled functions count with those that
  they name. The path of an iteration is that of the second ``trainer.step`` of a small fit by
  ``lfrtorch.identify``.
- Hops: calls from one file to another, in the package or ``train.py``, up to the first compiled
  simulation of the fit: the first compiled function of ``engine`` that is called from Python while
  functions of ``fitting`` and ``least_squares`` run. *On the stack*: neighbours of the call stack
  at that moment whose files differ; functions of other packages between them are left out. *Of the
  record*: direct calls that pass a record or give one back, by itself or in a data set, a list, a
  tuple or a dictionary; each (file of the caller, file of the function, function) counts once. The
  object of a method is not passed.
- An importer of a module is another module of the package with an import statement of it.
- Arguments: all but ``self`` and ``cls``, of functions that are not compiled. A function is public
  if neither its name nor its class's begins with an underscore.
- Constants: names in upper case, of two letters or more, assigned at the top of a module.
- Settings: fields of ``Settings`` and the trainers; and the leaves of
  ``conf/config.yaml`` composed with ``data=file``, without Hydra's own.
- Exclusions: raised errors whose message names two settings or more, as ``name=``, ``name is`` or
  ``{self.name}``.
- Edits for an activation: files of the package with the word softplus. Edits for a setting: files
  of the package, conf/ and docs/guide with the name of a field of ``Settings``;
  names without an underscore are left out, as most are words of English, too.
- ``Any``, ``cast``, ``assert``: uses in the package, imports left out.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import runpy
import statistics
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

Row = dict[str, str]

HOLDERS = {"Record", "NormalisedRecord", "RecordGroup", "Dataset"}
"""Classes that are a record or hold some."""

SHORT = ["trainer.max_iter=2", "figures=false", "threads=1"]
JOBS = {
    "main job": ["train.py", "+bench=boucwen", *SHORT],
    "CSV": [
        *["lfrtorch fit", "data=file", "data.path=x.csv", "data.inputs=[u]", "data.outputs=[y]"],
        *["data.fs=1", "nx=1", "nz=1", "nw=1", "nn=3", *SHORT],
    ],
}
"""Words of the two jobs whose hops are counted."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    own = Path(__file__).resolve().parents[1]
    parser.add_argument("checkouts", nargs="*", type=Path, default=[own], metavar="CHECKOUT")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    checkouts = [folder.resolve() for folder in arguments.checkouts]
    if arguments.part:
        PARTS[arguments.part](checkouts[0], lambda row: arguments.out.write_text(json.dumps(row)))
        return
    columns = [measured(checkout) for checkout in checkouts]
    names = list(dict.fromkeys(name for column in columns for name in column))
    heads = ["before", "after"] if len(columns) > 1 else ["measured"]
    print("| | " + " | ".join(heads) + " |\n" + "|---" * (1 + len(columns)) + "|")
    for name in names:
        print(f"| {name} | " + " | ".join(column.get(name, "") for column in columns) + " |")


def measured(checkout: Path) -> Row:
    """All rows of a checkout, each part in a process that imports the package from there."""
    row: Row = {}
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    for part in PARTS:
        with tempfile.TemporaryDirectory() as scratch:
            out = Path(scratch) / "row.json"
            command = [sys.executable, str(Path(__file__).resolve()), str(checkout)]
            command += ["--part", part, "--out", str(out)]
            run = subprocess.run(
                command, cwd=scratch, env=environment, capture_output=True, text=True, check=False
            )
            if not out.exists():
                sys.exit(f"{part} of {checkout} failed:\n{run.stdout}{run.stderr}")
            row |= json.loads(out.read_text())
    return row


# Text and syntax trees


def counts(checkout: Path, done: Callable[[Row], None]) -> None:
    """Everything that the source and the configuration say without a fit."""
    package = checkout / "lfrtorch"
    files = sorted(package.rglob("*.py"))
    trees = {path: ast.parse(path.read_text()) for path in files}
    rooms: dict[str, Counter[str]] = defaultdict(Counter)
    for path in files:
        inside = path.relative_to(package).parts
        rooms[inside[0] if len(inside) > 1 else "top"] += lines(path)
    total = sum(rooms.values(), Counter())
    kinds = ("all", "code", "docstring", "comment", "blank")
    row = {f"lines, {', '.join(kinds)}": "", "lfrtorch/": listed(total, kinds)}
    row |= {
        f"- {room}": listed(rooms[room], kinds) for room in ["top", *sorted({*rooms} - {"top"})]
    }
    tests = sum(map(lines, (checkout / "tests").rglob("*.py")), Counter[str]())
    row |= {"tests/": listed(tests, kinds), "files of lfrtorch/": str(len(files))}
    importers = Counter(name for path in files for name in imported(path, trees[path], package))
    row["modules with one importer"] = str(sum(count == 1 for count in importers.values()))
    sizes = [size for tree in trees.values() for size in argument_counts(tree.body)]
    for limit in (8, 10, 12):
        above = [public for count, public in sizes if count > limit]
        row[f"functions with more than {limit} arguments (public)"] = f"{len(above)} ({sum(above)})"
    row["constants"] = str(sum(len(constants(tree)) for tree in trees.values()))
    names, fields = settings()
    leaves = sum(1 for _ in leaf_keys(composed(checkout / "conf")))
    row["settings: fields, keys of the configuration"] = f"{len(fields)}, {leaves}"
    raised = [
        node for tree in trees.values() for node in ast.walk(tree) if is_exclusion(node, fields)
    ]
    row["exclusions"] = str(len(raised))
    sources = [
        p for p in package.rglob("*") if p.is_file() and p.suffix not in (".pyc", ".nbc", ".nbi")
    ]
    row["files to edit for an activation"] = str(files_with("(?i:softplus)", sources))
    guide = [*(checkout / "conf").rglob("*.yaml"), *(checkout / "docs/guide").rglob("*.md")]
    edits = {name: files_with(name, [*sources, *guide]) for name in names if "_" in name}
    most = max(edits, key=lambda name: edits[name])
    row["files to edit for a setting: median, most"] = (
        f"{statistics.median(edits.values()):g}, {edits[most]} ({most})"
    )
    contracts = tomllib.loads((checkout / "pyproject.toml").read_text())["tool"]["importlinter"]
    row["layers of the import contract"] = str(len(contracts["contracts"][0]["layers"]))
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    called = [node.func for node in nodes if isinstance(node, ast.Call)]
    row["Any, cast, assert"] = ", ".join(
        str(sum(uses))
        for uses in (
            [isinstance(node, ast.Name) and node.id == "Any" for node in nodes],
            [isinstance(function, ast.Name) and function.id == "cast" for function in called],
            [isinstance(node, ast.Assert) for node in nodes],
        )
    )
    done(row)


def listed(counted: Counter[str], kinds: tuple[str, ...]) -> str:
    """Counts with thousands marked."""
    return ", ".join(f"{counted[kind]:,}".replace(",", " ") for kind in kinds)


def lines(path: Path) -> Counter[str]:
    """Number of lines of each kind."""
    text = path.read_text()
    docstring: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Lambda | ast.IfExp):
            continue
        for statement in getattr(node, "body", ()):
            # A string that stands alone: of a module, a class, a function or a constant.
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                docstring |= {*range(statement.lineno, (statement.end_lineno or 0) + 1)}
    found: Counter[str] = Counter()
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        other = "comment" if stripped.startswith("#") else "code" if stripped else "blank"
        found["docstring" if number in docstring else other] += 1
        found["all"] += 1
    return found


def imported(path: Path, tree: ast.Module, package: Path) -> set[str]:
    """Other modules of the package that a module imports, by file."""
    found: set[Path] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        places = [package.parent.joinpath(*name.split(".")) for name in names]
        found |= {place.with_suffix(".py") for place in places}
    return {
        str(p.relative_to(package)) for p in found - {path} if package in p.parents and p.exists()
    }


def argument_counts(body: list[ast.stmt], public: bool = True) -> Iterator[tuple[int, bool]]:
    """Arguments of each function that is not compiled, and whether it is public."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from argument_counts(node.body, public and not node.name.startswith("_"))
        elif isinstance(node, ast.FunctionDef):
            shown = public and (not node.name.startswith("_") or node.name == "__init__")
            a = node.args
            names = [arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            if not any("jit" in ast.unparse(decorator) for decorator in node.decorator_list):
                yield len([name for name in names if name not in ("self", "cls")]), shown
            yield from argument_counts(node.body, public=False)


def constants(tree: ast.Module) -> list[str]:
    """Names in upper case that a module assigns."""
    targets: list[ast.expr] = []
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets += node.targets
        elif isinstance(node, ast.AnnAssign):
            targets.append(node.target)
    names = [
        node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)
    ]
    return [name for name in names if re.fullmatch(r"_?[A-Z][A-Z0-9_]+", name)]


def settings() -> tuple[list[str], list[str]]:
    """Fields of ``Settings``, and these with those of the trainers."""
    import dataclasses

    import lfrtorch

    def names(*classes: str) -> list[str]:
        found = [getattr(lfrtorch, name) for name in classes if hasattr(lfrtorch, name)]
        return [field.name for each in found for field in dataclasses.fields(each)]

    own = names("Settings")
    return own, own + names("LevenbergMarquardt", "Adam")


def composed(conf: Path) -> Any:
    """The configuration of a fit to a file."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    import lfrtorch.cli.fit  # noqa: F401 (its resolvers)

    with initialize_config_dir(str(conf), version_base="1.3"):
        return OmegaConf.to_container(compose("config", ["data=file"]), resolve=False)


def leaf_keys(node: Any, key: str = "") -> Iterator[str]:
    """Dotted names of all values but Hydra's targets."""
    if not isinstance(node, dict) or not node:
        yield key
        return
    for name, value in node.items():
        if not (name.startswith("_") or (not key and name == "hydra")):
            yield from leaf_keys(value, f"{key}.{name}".lstrip("."))


def is_exclusion(node: ast.AST, fields: list[str]) -> bool:
    """Whether a node raises an error whose message names two settings."""
    if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)):
        return False
    text = ""
    for part in ast.walk(node.exc):
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            text += f" {part.value}"
        elif isinstance(part, ast.FormattedValue) and isinstance(part.value, ast.Attribute):
            text += f" {part.value.attr}="
    return len({name for name in {*fields} if re.search(rf"\b{name}(=| is )", text)}) > 1


def files_with(word: str, files: list[Path]) -> int:
    """Number of files that have a word."""
    return sum(
        re.search(rf"\b{word}\b", file.read_text(errors="ignore")) is not None for file in files
    )


# Calls


def watch_kernels(called: Callable[[FunctionType], None]) -> None:
    """Tell of every call of a compiled function from Python."""
    from numba.core.registry import CPUDispatcher

    original = CPUDispatcher.__call__

    def spy(self: Any, *args: Any, **kwargs: Any) -> Any:
        called(self.py_func)
        return original(self, *args, **kwargs)

    CPUDispatcher.__call__ = spy


def compiled_files(function: FunctionType) -> set[str]:
    """Files of a compiled function and of those that it names."""
    found, waiting = set[CodeType](), [function]
    while waiting:
        current = waiting.pop()
        if current.__code__ not in found:
            found.add(current.__code__)
            named = (current.__globals__.get(name) for name in current.__code__.co_names)
            waiting += [value.py_func for value in named if isinstance(value, Dispatcher)]
    return {code.co_filename for code in found}


def iteration(checkout: Path, done: Callable[[Row], None]) -> None:
    """Files that one iteration of Levenberg-Marquardt passes through, and their lines."""
    import lfrtorch

    package, files = str(checkout / "lfrtorch"), set[str]()
    step, steps, watching = lfrtorch.LevenbergMarquardt.step, Counter[str](), [False]
    watch_kernels(lambda function: files.update(compiled_files(function)) if watching[0] else None)

    def watched(self: Any, *args: Any) -> Any:
        steps["all"] += self is trainer  # the linear model has searches, too
        watching[0] = steps["all"] == 2  # the first one compiles
        if watching[0]:
            sys.setprofile(lambda frame, event, _: files.add(frame.f_code.co_filename))
        found = step(self, *args)
        sys.setprofile(None)
        steps["all"] += watching[0]
        watching[0] = False
        return found

    u, y = saturation()
    record = lfrtorch.Record(np.array(u), np.array(y))
    dataset = lfrtorch.Dataset("house", [record[:400]], [], [record[400:]])
    lfrtorch.LevenbergMarquardt.step = watched  # pyright: ignore[reportAttributeAccessIssue]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=3)
    lfrtorch.identify(dataset, lfrtorch.Settings(nx=1, nz=1, nn=3, trainer=trainer))
    passed = sorted(Path(name) for name in files if name.startswith(package))
    total = sum(lines(path)["all"] for path in passed)
    done({"files of an iteration of Levenberg-Marquardt, their lines": f"{len(passed)}, {total}"})


def saturation() -> tuple[list[float], list[float]]:
    """A first-order system that saturates at its input."""
    import numpy as np

    u, y = np.random.default_rng(0).standard_normal(600), np.zeros(600)
    for k in range(599):
        y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
    return u.tolist(), y.tolist()


def hops(job: str) -> Callable[[Path, Callable[[Row], None]], None]:
    """Count the hops of a job; its process ends with the first simulation of the fit."""

    def count(checkout: Path, done: Callable[[Row], None]) -> None:
        package, passed = f"{checkout / 'lfrtorch'}{os.sep}", set[tuple[str, str, str]]()
        entry = str(checkout / "train.py")

        def own(name: str) -> bool:
            return name.startswith(package) or name == entry

        def watch(frame: FrameType, event: str, value: Any) -> None:
            caller, code = frame.f_back, frame.f_code
            if caller is None or event not in ("call", "return"):
                return
            callers, file = caller.f_code.co_filename, code.co_filename
            if callers == file or not (own(callers) and own(file)):
                return
            several = code.co_argcount + code.co_kwonlyargcount + 2  # *args, **kwargs
            names = [name for name in code.co_varnames[:several] if name not in ("self", "cls")]
            given = [frame.f_locals.get(name) for name in names] if event == "call" else [value]
            if any(map(holds_record, given)):
                passed.add((callers, file, code.co_qualname))

        def stop(function: FunctionType) -> None:
            frame, stack = sys._getframe(2), [function.__code__.co_filename]
            while frame is not None:
                stack.append(frame.f_code.co_filename)
                frame = frame.f_back
            stack = [name for name in stack if own(name)]
            fits = any(name.endswith(f"fitting{os.sep}trainer.py") for name in stack)
            if not fits or f"{os.sep}engine{os.sep}" not in stack[0]:
                return
            sys.setprofile(None)
            depth = sum(a != b for a, b in pairwise(stack))
            done({f"hops of the {job}: on the stack, of the record": f"{depth}, {len(passed)}"})
            if os.environ.get("HOUSE_TRACE"):
                print(*reversed(stack), *sorted(passed), sep="\n", file=sys.stderr)
            os._exit(0)

        watch_kernels(stop)
        u, y = saturation()
        rows = [f"{a},{b}" for a, b in zip(u, y, strict=True)]
        Path("x.csv").write_text("\n".join(["u,y", *rows]) + "\n")
        sys.argv = JOBS[job]
        if sys.argv[0] == "train.py":
            sys.setprofile(watch)
            runpy.run_path(entry, run_name="__main__")
        else:
            from lfrtorch.cli.command import main as command

            sys.argv = [*sys.argv[0].split(), *sys.argv[1:]]
            sys.setprofile(watch)
            command()

    return count


def holds_record(value: Any) -> bool:
    """Whether a value is a record, or holds one."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple) and type(value).__name__ not in HOLDERS:
        return any(map(holds_record, value[:3]))
    return type(value).__name__ in HOLDERS


PARTS = {"counts": counts, "iteration": iteration} | {job: hops(job) for job in JOBS}
"""What is measured in processes of their own."""


if __name__ == "__main__":
    main()
