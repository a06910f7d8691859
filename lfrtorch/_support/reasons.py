"""Reasons for the end of a search or a fit."""

from __future__ import annotations

from enum import StrEnum


class Reason(StrEnum):
    """Reason for the end of a search or a fit; a member equals its text in files and reports.

    A user's trainer may give other texts.

    Example:
        >>> result = lfrtorch.fit(model, record, trainer=lfrtorch.LevenbergMarquardt(max_iter=2))
        >>> result.reason is lfrtorch.Reason.ALL_ITERATIONS, str(result.reason)
        (True, 'maximum number of iterations')
    """

    RESIDUAL_VANISHES = "converged: the residual vanishes"
    COST_SETTLED = "converged: the cost no longer falls"
    NO_STEP_LEFT = "converged: no step lowers the cost"
    JACOBIAN_VANISHES = "the Jacobian vanishes or is not finite"
    GRADIENT_DIVERGED = "diverged: lower the learning rate"
    ALL_ITERATIONS = "maximum number of iterations"
    ALL_EPOCHS = "maximum number of epochs"
    NO_ITERATIONS = "no iterations asked for"
    START_DIVERGES = "diverges at the start"
    OTHERS_BETTER = "others were better"
    INTERRUPTED = "interrupted"
    PROCESS_LOST = "a process was lost"


SPENT = (Reason.ALL_ITERATIONS, Reason.ALL_EPOCHS)
"""Reasons of a search that more iterations would continue."""

CUT_SHORT = (Reason.INTERRUPTED, Reason.PROCESS_LOST)
"""Reasons of a fit that was interrupted from outside."""


def told(reason: str, detail: str) -> str:
    """Text of a reason, with its detail if there is one."""
    return f"{reason}: {detail}" if detail else reason
