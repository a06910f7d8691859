"""The annotations of the package are checked while its tests run."""

import pytest
import torch

from lfrtorch.engine.linear_recurrence import linear_recurrence


def test_shapes_that_do_not_fit_are_refused():
    F, g = torch.zeros(2, 5, 3, 3), torch.zeros(2, 5, 3, 1)
    assert linear_recurrence(F, g, torch.zeros(2, 3, 1)).shape == (2, 6, 3, 1)
    with pytest.raises(TypeError, match="linear_recurrence"):
        linear_recurrence(F, g, torch.zeros(2, 4, 1))
