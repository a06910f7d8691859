"""The MATLAB function of a model, run by Octave beside the model."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported import (
    MODELS,
    OBSERVED,
    check_output,
    check_rest,
    inputs,
    jacobians,
    measured_with_gaps,
    some_noise,
)
from scipy.io import loadmat, savemat

from lfrtorch import InputError
from lfrtorch.analysis import lpv
from lfrtorch.export import write
from lfrtorch.model.extended_kalman_filter import ExtendedKalmanFilter

WRITTEN = [name for name in MODELS if name not in ("known", "drag")]

needs_octave = pytest.mark.skipif(
    not shutil.which("octave-cli"), reason="there is no octave-cli (Debian's package octave)"
)

SCRIPT = """
names = fieldnames(load('tried.mat'));
tried = load('tried.mat');
for i = 1:numel(names)
    name = names{i}; t = tried.(name);
    f = str2func(name);
    [r.x_next, r.y, r.A, r.B, r.C, r.D] = f(t.x, t.u(1, :));
    x = zeros(numel(t.x), 1); y = [];
    for k = 1:rows(t.u)
        [x, y_k] = f(x, t.u(k, :));
        y(k, :) = y_k;
    end
    r.run = y;
    m = load([name '.mat']);
    r.x_rest = m.x_rest;
    f = m.lpv;
    lpv = str2func([name '_lpv']);
    x = zeros(numel(t.x), 1); y = []; ps = [];
    for k = 1:200
        [A, B, C, D, p] = lpv(x, t.u(k, :));
        y(k, :) = f.y0 + C * (x - f.x0) + D * (t.u(k, :).' - f.u0);
        x = f.x_next0 + A * (x - f.x0) + B * (t.u(k, :).' - f.u0);
        ps(k, :) = p;
    end
    r.lpv_run = y; r.p = ps;
    if isfield(t, 'y')
        for kind = {'k', 'ekf'}
            observer = [name '_' kind{1}];
            [start, correct, advance] = deal(str2func([observer '_start']), ...
                str2func([observer '_correct']), str2func([observer '_advance']));
            s = start();
            before = []; after = [];
            for k = 1:rows(t.y)
                if mod(k, 5)
                    s = correct(s, t.u(k, :), t.y(k, :));
                end
                before(k, :) = s.x;
                s = advance(s, t.u(k, :));
                after(k, :) = s.x;
            end
            r.(kind{1}) = struct('before', before, 'after', after);
            if isfield(s, 'P')
                r.(kind{1}).P = s.P;
            end
        end
    end
    r.refused = {};
    for wrong = {{t.x, [t.u(1, :) 1]}, {[t.x; 1], t.u(1, :)}}
        for g = {str2func(name), lpv}
            try
                g{1}(wrong{1}{:});
            catch e
                r.refused{end + 1} = e.message;
            end
        end
    end
    found.(name) = r;
end
save('-v7', 'found.mat', '-struct', 'found');
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What Octave computes for all models."""
    folder = tmp_path_factory.mktemp("matlab")
    tried = {}
    for name in WRITTEN:
        model = MODELS[name]
        write(model, "matlab", folder, name=f"f_{name}")
        x = np.random.default_rng(4).normal(size=(model.lfr.cell.nx, 1))
        tried[f"f_{name}"] = {"x": x, "u": inputs(model, 1000)}
        if name in OBSERVED:
            tried[f"f_{name}"]["y"] = measured_with_gaps(OBSERVED[name], 60)[1]
            for kind, observer in (("k", True), ("ekf", some_noise(model))):
                made = OBSERVED[name], "matlab", folder
                write(*made, name=f"f_{name}_{kind}", observer=observer)
    savemat(folder / "tried.mat", tried)
    (folder / "run_all.m").write_text(SCRIPT)
    command = ["octave-cli", "--no-init-file", "--no-history", "run_all.m"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return loadmat(folder / "found.mat", simplify_cells=True)


@needs_octave
@pytest.mark.numeric
@pytest.mark.parametrize("name", WRITTEN)
def test_samples_and_jacobians_are_those_of_the_model(name: str, found: dict[str, Any]):
    model, one = MODELS[name], found[f"f_{name}"]
    u = inputs(model, 1000)
    check_output(np.reshape(one["run"], (1000, -1)), model, u)
    check_rest(np.atleast_1d(one["x_rest"]), model)
    x = np.random.default_rng(4).normal(size=model.lfr.cell.nx)
    for letter, expected in zip("ABCD", jacobians(model, x, u[0]), strict=True):
        error = np.reshape(one[letter], expected.shape) - expected
        assert np.abs(error).max() <= 1e-12 * np.abs(expected).max()


@needs_octave
@pytest.mark.numeric
@pytest.mark.parametrize("name", WRITTEN)
def test_the_lpv_form_runs_as_the_model(name: str, found: dict[str, Any]):
    model, one = MODELS[name], found[f"f_{name}"]
    u, form = inputs(model, 1000)[:200], lpv(model)
    check_output(np.reshape(one["lpv_run"], (200, -1)), model, u)
    p = form.scheduling(model.signals(u).x[0, :-1].numpy(), u)
    np.testing.assert_allclose(np.reshape(one["p"], p.shape), p, rtol=0, atol=1e-9)


@needs_octave
@pytest.mark.numeric
@pytest.mark.parametrize("kind", ["k", "ekf"])
@pytest.mark.parametrize("name", [name for name in OBSERVED if name in WRITTEN])
def test_observers_are_those_of_the_model(name: str, kind: str, found: dict[str, Any]):
    model, one = OBSERVED[name], found[f"f_{name}"][kind]
    observer = model.observer(noise=some_noise(model)) if kind == "ekf" else model.observer()
    before, after = [], []
    for k, (u, y) in enumerate(zip(*measured_with_gaps(model, 60), strict=True)):
        if k % 5 != 4:
            observer.correct(y, u)
        before.append(observer.state)
        observer.advance(u)
        after.append(observer.state)
    for when, expected in (("before", before), ("after", after)):
        states = np.reshape(one[when], np.shape(expected))
        np.testing.assert_allclose(states, expected, rtol=1e-9, atol=1e-9)
    if isinstance(observer, ExtendedKalmanFilter):
        P = np.reshape(one["P"], observer.covariance.shape)
        np.testing.assert_allclose(P, observer.covariance, rtol=1e-9, atol=1e-11)


@needs_octave
def test_another_number_of_inputs_or_states_is_refused(found: dict[str, Any]):
    said = found["f_polynomial"]["refused"]
    message = "f_polynomial takes x of 2 and u of 2 numbers; these have "
    assert list(said) == [
        message + f"{each}." for each in ("2 and 3", "2 and 3", "3 and 2", "3 and 2")
    ]


@pytest.mark.parametrize("name", ["known", "drag"])
def test_a_map_without_arrays_has_no_matlab_code(name: str, tmp_path: Path):
    with pytest.raises(InputError, match=r"needs a network or a polynomial, .* map to c"):
        write(MODELS[name], "matlab", tmp_path)
