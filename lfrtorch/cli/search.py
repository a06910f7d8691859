"""Settings that a search chooses by the validation error: Optuna proposes, a run each tries them.

lfrtorch search +bench=silverbox nn=5,10,15,20 nz=1,2 trials=40 out=runs/search

References:
    Bergstra et al., "Algorithms for hyper-parameter optimization", NeurIPS 2011.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lfrtorch._support.errors import InputError, LfrtorchError

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.distributions import BaseDistribution

    from lfrtorch.fitting.trainer import Monitor

ABOUT = """Search for the settings of lfrtorch fit that validate best.

    lfrtorch search +bench=silverbox 'nn=range(4,31)' nz=1,2,3 out=runs/search trials=60
    lfrtorch search data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=750 \\
        nx=2,3,4 nn=5,10,15 'ridge=tag(log,interval(1e-8,1e-2))' workers=4

Words are those of lfrtorch fit; those with several values are searched:

  nn=5,10,15                          one of these
  'nn=range(4,31)'                    a whole number from 4 to 30
  'ridge=tag(log,interval(1e-8,1e-2))'   a number between, on a logarithmic scale

and of the search itself:

  trials=N      runs in all. Default: 40
  minutes=X     after which no run begins. Default: no limit
  workers=N     of them at once, on one machine. Default: 1
  objective=    error (of validation, the default); front: of error against number of parameters;
                front_time: of error against seconds of the fit
  out=DIR       folder. Default: runs/search. The same command goes on there, also from several
                machines at once if they share the folder

A run of one start that is worse than most others after as many iterations is ended (not for a
front). The folder has each run, and comparison.html of them all.
"""

NAME = "search"  # of the study in its journal
JOURNAL, FAILED = "journal.log", "failed"
OWN = {
    "trials": "40",
    "minutes": "inf",
    "workers": "1",
    "objective": "error",
    "out": "runs/search",
}
FRONTS = {
    "front": lambda metrics: metrics["parameters_net"],
    "front_time": lambda metrics: metrics["fit"]["seconds"],
}
"""What a front has beside the error, in the ``metrics.json`` of a run."""
OBJECTIVES = ("error", *FRONTS)
BEGINS = 60.0  # seconds within which a worker that has a trial is at it
TRIED = 5  # runs that come to their end before any is pruned
JUDGED = 8  # and this part of the iterations: the first eighth tells little


class PrunedError(LfrtorchError):
    """A run that others have left behind."""


class Plan(NamedTuple):
    """What is searched.

    Args:
        fixed: words of all runs.
        space: where each of the others is searched, by its name.
        trials, minutes, workers, objective, folder: see ``ABOUT``.
    """

    fixed: list[str]
    space: dict[str, BaseDistribution]
    trials: int
    minutes: float
    workers: int
    objective: str
    folder: Path


def parser() -> argparse.ArgumentParser:
    """Reads the command line."""
    found = argparse.ArgumentParser(
        prog=sys.argv[0], description=ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("words", nargs="+", metavar="WORD", help="of lfrtorch fit, or of the search")
    return found


def launch() -> None:
    """The command line."""
    from lfrtorch.cli.errors import user_errors

    words = parser().parse_args().words
    with user_errors():
        search(words)


def search(words: Sequence[str]) -> None:
    """Try settings until there are as many trials as asked for, then show them."""
    found = plan(words)
    study = opened(found)
    others = [
        subprocess.Popen([sys.executable, "-c", WORKER, *words]) for _ in range(found.workers - 1)
    ]
    work(found)
    for other in others:
        other.wait()
    show(found, study)


WORKER = f"import sys; from {__name__} import plan, work; work(plan(sys.argv[1:]))"


def work(found: Plan) -> None:
    """Try settings; other processes may do the same."""
    study, end = opened(found), time.monotonic() + 60.0 * found.minutes
    try_again(found, study)
    while begun(study) < found.trials and time.monotonic() < end:
        trial = study.ask(found.space)
        study.tell(trial, **tried(found, trial))


def begun(study: Study) -> int:
    """Trials that have come to their end, or are about to; none that was killed."""
    return sum(
        trial.state.name in ("RUNNING", "COMPLETE", "PRUNED") or FAILED in trial.user_attrs
        for trial in study.trials
    )


def try_again(found: Plan, study: Study) -> None:
    """Have the trials of workers that were killed tried once more."""
    from optuna.trial import TrialState

    from lfrtorch.cli.study import alone

    for trial in study.get_trials(states=[TrialState.RUNNING]):
        folder = folder_of(found, trial.params)
        assert trial.datetime_start is not None
        age = (datetime.now() - trial.datetime_start).total_seconds()
        if age < BEGINS or not trial.params:
            continue
        folder.mkdir(exist_ok=True)
        with suppress(BlockingIOError), alone(folder, wait=False):
            study.tell(trial.number, state=TrialState.FAIL)
            study.enqueue_trial(trial.params)


def folder_of(found: Plan, params: Mapping[str, Any]) -> Path:
    """Where the run of a trial is."""
    from lfrtorch.cli.study import folder_name

    return found.folder / folder_name(",".join(words_of(params)))


def words_of(params: Mapping[str, Any]) -> list[str]:
    """What a trial tries, as words."""
    return [f"{name}={value}" for name, value in params.items()]


def plan(words: Sequence[str]) -> Plan:
    """What the command line asks for.

    Raises:
        ValueError: words that ``lfrtorch fit`` does not take, or nothing to search.
    """
    from lfrtorch.cli.composition import check_words, parsed
    from lfrtorch.cli.quotes import quoted

    own = dict(OWN)
    rest = []
    for word in words:
        name, _, value = word.partition("=")
        if name in OWN:
            own[name] = value
        else:
            rest.append(word)
    if own["objective"] not in OBJECTIVES:
        raise InputError(f"objective is {own['objective']}; give {', '.join(OBJECTIVES)}.")
    for name in ("trials", "workers"):
        if not own[name].isdecimal() or int(own[name]) < 1:
            raise InputError(f"{name} is {own[name]}; give a whole number of at least 1.")
    try:
        minutes = float(own["minutes"])
    except ValueError:
        minutes = math.nan
    if not minutes > 0:
        raise InputError(f"minutes is {own['minutes']}; give a number above 0.")
    check_words("config", ["-m", *rest])
    read = [parsed(word) for word in rest]
    space = {w.get_key_element(): distribution(w) for w in read if w.is_sweep_override()}
    if not space:
        raise InputError("no word has several values to search: nn=5,10,15 or 'nn=range(4,31)'.")
    fixed = [quoted(str(word.input_line)) for word in read if not word.is_sweep_override()]
    return Plan(
        fixed,
        space,
        trials=int(own["trials"]),
        minutes=minutes,
        workers=int(own["workers"]),
        objective=own["objective"],
        folder=Path(own["out"]),
    )


def distribution(word: Any) -> BaseDistribution:
    """Where the values of a word of Hydra lie."""
    try:
        from optuna import distributions
    except ImportError:
        raise InputError("lfrtorch search needs: pip install 'lfrtorch[search]'.") from None

    value = word.value()
    log = "log" in getattr(value, "tags", ())
    if word.is_interval_sweep():
        if all(isinstance(end, int) for end in (value.start, value.end)):
            return distributions.IntDistribution(value.start, value.end, log=log)
        return distributions.FloatDistribution(value.start, value.end, log=log)
    steps = word.is_range_sweep() and not value.shuffle
    whole = steps and all(isinstance(x, int) for x in (value.start, value.stop, value.step))
    if whole and value.step > 0:
        last = value.start + (value.stop - 1 - value.start) // value.step * value.step
        return distributions.IntDistribution(value.start, last, step=value.step)
    return distributions.CategoricalDistribution(list(word.sweep_string_iterator()))


def journal(folder: Path) -> Any:
    """The storage of a study; several processes may write to it."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    return JournalStorage(JournalFileBackend(str(folder / JOURNAL)))


def opened(found: Plan) -> Study:
    """The study in the folder, a new one if there is none.

    Raises:
        ValueError: the folder has a study of other words.
    """
    import optuna
    from optuna.study import StudyDirection

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    found.folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=journal(found.folder),
        study_name=NAME,
        directions=[StudyDirection.MINIMIZE] * (1 + (found.objective in FRONTS)),
        sampler=optuna.samplers.TPESampler(constant_liar=True),
        load_if_exists=True,
    )
    asked = {"fixed": sorted(found.fixed), "objective": found.objective}
    before = study.user_attrs or asked
    if before != asked:
        raise InputError(
            f"out is '{found.folder}', whose runs have other settings "
            f"({', '.join(before['fixed'])}, objective={before['objective']}); give another folder."
        )
    for name, value in asked.items():
        study.set_user_attr(name, value)
    return study


def tried(found: Plan, trial: Trial) -> dict[str, Any]:
    """What became of a trial, as ``Study.tell`` takes it."""
    from omegaconf import OmegaConf
    from optuna.trial import TrialState

    from lfrtorch.cli import fit, study
    from lfrtorch.cli.composition import composed

    task = [*found.fixed, *words_of(trial.params)]
    folder = folder_of(found, trial.params)
    folder.mkdir(exist_ok=True)
    cfg = composed("config", task)
    least = int(OmegaConf.select(cfg, "trainer.max_iter", default=0)) // JUDGED
    judge = partial(report, found.folder, trial._trial_id, least)
    work = partial(
        fit.launched,
        folder=folder,
        command=shlex.join(["lfrtorch", "fit", *task]),
        monitor=judge if found.objective == "error" else None,
    )
    launcher = {"_target_": NAME}  # a thread each: as many as cores make most of a machine
    hydra = OmegaConf.create({"overrides": {"task": task}, "launcher": launcher})
    error = study.job(work, cfg, folder, hydra=hydra)
    if math.isnan(error):
        why = (folder / study.FAILED).read_text(encoding="utf-8")
        if why.startswith(study.PRUNED):
            return {"state": TrialState.PRUNED}
        trial.set_user_attr(FAILED, why)
        return {"state": TrialState.FAIL}
    if found.objective == "error":
        return {"values": error}
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return {"values": [error, FRONTS[found.objective](metrics)]}


def report(folder: Path, number: int, least: int) -> Monitor:
    """What tells the study how a run goes on, made in the process of the run.

    Args:
        folder, number: of the study, and of the trial in its journal.
        least: iterations after which others may be compared.
    """
    import optuna

    from lfrtorch.cli.study import PRUNED

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    pruner = optuna.pruners.MedianPruner(TRIED, n_warmup_steps=least)
    study = optuna.load_study(study_name=NAME, storage=journal(folder), pruner=pruner)
    trial = optuna.Trial(study, number)

    def told(_: Any, progress: Any) -> None:
        judged = progress.validation
        trial.report(progress.train if math.isnan(judged) else judged, progress.iteration)
        if trial.should_prune():
            raise PrunedError(f"{PRUNED} after {progress.iteration} iterations: others are better")

    return told


def show(found: Plan, study: Study) -> None:
    """Print the runs and the best one, or those of the front."""
    from lfrtorch.cli import compare

    states = Counter(trial.state.name for trial in study.trials)
    if states["COMPLETE"]:
        print()
        compare.run([found.folder])
    failed = sum(FAILED in trial.user_attrs for trial in study.trials)
    print(f"\n{states['COMPLETE']} runs, {states['PRUNED']} pruned, {failed} failed")
    for trial in study.best_trials:
        print("best:", *words_of(trial.params))
