"""Steps of several heights."""

from dataclasses import replace

import numpy as np
import pytest

import lfrtorch
from lfrtorch.reporting.step_plots import steps


def saturating(samples: int = 800) -> lfrtorch.Record:
    u = 1.0 + np.repeat(np.random.default_rng(0).standard_normal(samples // 4), 4)
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + np.tanh(u[k] - 1.0)
    source, output = lfrtorch.Channel("valve", "%"), lfrtorch.Channel("flow", "l/s")
    return lfrtorch.Record(u, y, fs=10.0, skip=20, inputs=(source,), outputs=(output,))


def test_steps_of_a_linear_model_lie_on_each_other():
    record = saturating()
    linear = lfrtorch.estimate_bla(record, 1)
    ax = steps(linear.to_model(), linear, [record]).axes[0]
    *of_model, of_linear = ax.lines
    assert len(of_model) == 4
    for line in of_model:
        assert np.allclose(np.asarray(line.get_ydata()), np.asarray(of_linear.get_ydata()))
    dc = linear.D + linear.C @ np.linalg.solve(np.eye(1) - linear.A, linear.B)
    np.testing.assert_allclose(np.asarray(of_linear.get_ydata())[-1], dc[0, 0], rtol=0.02)
    assert ax.get_ylabel() == "flow per valve (l/s/%)"
    assert ax.get_xlabel() == "time after the step (s)"


def test_steps_of_a_saturation_gain_less_the_higher_they_are():
    record = saturating()
    settings = lfrtorch.Settings(nx=1, nz=1, nn=6, starts=1)
    run = lfrtorch.identify(lfrtorch.Dataset("saturation", [record]), settings)
    low, half, more, high, _ = (
        float(np.asarray(line.get_ydata())[-1])
        for line in steps(run.model, run.linear, [record]).axes[0].lines
    )
    exact = [np.tanh(h) / h / 0.3 for h in np.percentile(record.u - 1.0, [2, 98])]
    np.testing.assert_allclose([low, high], exact, rtol=0.1)
    assert half > low
    assert more > high


def test_a_model_without_rest_has_no_steps():
    record = saturating()
    linear = lfrtorch.estimate_bla(record, 1)
    integrating = replace(linear, A=np.ones((1, 1)))
    with pytest.raises(ValueError, match="does not come to rest"):
        steps(linear.to_model(), integrating, [record])
    with pytest.raises(ValueError, match="does not come to rest"):
        steps(integrating.to_model(), linear, [record])


def test_each_input_has_its_heights_and_each_output_its_own_rest():
    u = np.random.default_rng(0).standard_normal((600, 2)) * [1.0, 100.0]
    fast, slow = np.zeros(600), np.zeros(600)
    for k in range(599):  # the first input moves the first output alone, in other units
        fast[k + 1] = 0.5 * fast[k] + 1e6 * u[k, 0]
        slow[k + 1] = 0.9 * slow[k] + 1e-3 * u[k, 1]
    record = lfrtorch.Record(u, np.column_stack([fast, slow]), skip=20)
    linear = lfrtorch.estimate_bla(record, 2)
    axes = steps(linear.to_model(), linear, [record]).axes
    assert len(axes) == 4
    for ax, reach in zip(axes[:2], (2.0, 200.0), strict=True):
        legend = ax.get_legend()
        assert legend is not None
        first = float(legend.get_texts()[0].get_text())
        assert -1.3 * reach < first < -0.7 * reach
