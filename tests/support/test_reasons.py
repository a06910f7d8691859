"""Reasons are named in the program, and texts for people and in files."""

import json

from lfrtorch import Reason
from lfrtorch._support.reasons import CUT_SHORT, SPENT, told


def test_a_reason_equals_the_text_that_files_hold():
    for reason in Reason:
        assert json.loads(json.dumps({"reason": reason}))["reason"] == reason
        assert f"{reason}" == reason.value
    assert "maximum number of iterations" in SPENT
    assert "interrupted" in CUT_SHORT
    assert "converged: the cost no longer falls" not in (*SPENT, *CUT_SHORT)


def test_a_detail_follows_its_reason():
    assert told(Reason.PROCESS_LOST, "rank 1") == "a process was lost: rank 1"
    assert told(Reason.INTERRUPTED, "") == "interrupted"
