"""Snapshots of the starts of a fit on disk, from which an interrupted fit can continue."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from time import monotonic

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError, brief
from lfrtorch.fitting import state_file
from lfrtorch.fitting.trainer import Fit, Keep

_ROUNDS = "rounds.json"


class Snapshots:
    """A folder with a file for each start, and a file that lists the starts kept after each round.

    Args:
        folder: folder of the files. Default: nothing is saved.
        every: shortest time in seconds between two writes for one start; a start is also written
            at the end of each round.
        writes: True if this process writes files; of several processes only the first one should.

    Raises:
        ValueError: damaged files.

    Example:
        >>> from pathlib import Path
        >>> def fitted(limit):
        ...     start = lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4)
        ...     trainer = lfrtorch.LevenbergMarquardt(max_iter=limit)
        ...     snapshots = lfrtorch.Snapshots(Path("fit"))
        ...     return lfrtorch.fit(start, record, trainer=trainer, snapshots=snapshots)
        >>> first = fitted(3)
        >>> longer = fitted(5)  # goes on from the third iteration
        >>> longer.history[3].train == first.history[3].train, longer.iterations
        (True, 5)
    """

    def __init__(
        self, folder: Path | None = None, every: float = 10.0, *, writes: bool = True
    ) -> None:
        self.folder, self.every = folder, every
        self._writes = writes and folder is not None
        self.rounds: list[list[int]] = []
        """Numbers of the starts that went on after each round that has ended."""
        self._count: int | None = None
        if folder is not None and (file := folder / _ROUNDS).is_file():
            try:
                found = json.loads(file.read_text())
                self._count, self.rounds = int(found["starts"]), found["rounds"]
                if any(type(start) is not int for decided in self.rounds for start in decided):
                    raise ValueError("starts that are no numbers")
            except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
                raise InputError(
                    f"'{file}' is damaged ({brief(error)}); start from the best model of the run "
                    "instead: init_from=DIR."
                ) from None

    @property
    def least(self) -> float:
        """Least normalised squared error of all iterates; infinite if there is none."""
        files = [self._file(number) for number in range(self._count or 0)]
        found = [state_file.read(file)[0]["at"] for file in files if file.is_file()]
        return min((at["history"][at["chosen"]]["score"] for at in found), default=math.inf)

    def restore(self, fits: Sequence[Fit]) -> None:
        """Restore the fits that have files; raise a ValueError if the number of starts differs."""
        if self.folder is None:
            return
        if self._count is None:
            self._count = len(fits)
            self._write()
        if self._count != len(fits):
            raise InputError(
                f"the run to be continued has {self._count} start(s), but {len(fits)} are given; "
                f"give {self._count}, or begin a new run."
            )
        for number, fit in enumerate(fits):
            if self._file(number).is_file():
                fit.restore(self._file(number))

    def keeper(self, number: int) -> Keep:
        """Return a function that writes the file of a start when a write is due."""
        due = monotonic() + self.every

        def keep(fit: Fit, paused: bool) -> None:
            nonlocal due
            if self._writes and fit.history and (paused or monotonic() >= due):
                fit.save(self._file(number))
                due = monotonic() + self.every

        return keep

    def take(self, number: int, state: bytes) -> None:
        """Write the file of a start that another process has fitted."""
        if self._writes:
            with whole_file(self._file(number)) as fresh:
                fresh.write_bytes(state)

    def decided(self, numbers: list[int]) -> None:
        """Note which starts go on after a round."""
        self.rounds.append(numbers)
        self._write()

    def _file(self, number: int) -> Path:
        assert self.folder is not None
        return self.folder / f"{number}.safetensors"

    def _write(self) -> None:
        if self._writes:
            assert self.folder is not None
            with whole_file(self.folder / _ROUNDS) as fresh:
                fresh.write_text(json.dumps({"starts": self._count, "rounds": self.rounds}) + "\n")
