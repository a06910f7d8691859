"""The main fit of an identification: all starts are fitted to all training records."""

from __future__ import annotations

from dataclasses import replace

from lfrtorch.fitting.stage import Data, Job, Stage

SLOW_SAMPLES = 5000
"""Number of training samples from which a note warns of a static map that is not compiled."""


class WholeFit(Stage):
    """The fit that is scored; its result is kept also if it was cut short."""

    def run(self, job: Job) -> Job:
        """The job with its result."""
        dataset, models, observer = job.dataset, list(job.models), job.observer
        samples = sum(record.samples for record in dataset.train)
        if samples >= SLOW_SAMPLES and models[0].lfr.cell.map.code is None:
            observer.say(
                "note: the static map is a module of your own, which is not compiled: an iteration "
                "takes about ten times as long as with a network or a polynomial"
            )
        observer.say(
            f"{dataset.name}: {samples} training samples, "
            f"{models[0].parameter_count} parameters "
            f"({models[0].net_parameter_count} without the gauge directions), "
            f"{len(models)} start(s)"
        )
        monitors, watch = observer.begin(dataset, job.settings, job.linear, models)
        result = job.fit(
            models,
            Data.of(dataset),
            trainer=job.settings.trainer,
            average=job.settings.average,
            monitors=monitors,
            watch=watch,
            snapshots=job.snapshots,
        )
        observer.end(result)
        return replace(job, result=result)
