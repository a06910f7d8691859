"""Forward and backward passes of recurrent layers beside an LFR, on one core.

    python benchmarks/layers.py [--rounds 20]

Prints a table for docs/guide/layer.md: milliseconds of y = layer(u) and the gradient of mean(y²),
medians over rounds in which all layers take turns, and the ratio to the LFR. The LFR has four
states, two z, two w and ten neurons; nn's layers have 16 units, about as many numbers as the LFR;
those of tsfast and neural-ssm, if they are installed, their defaults with four and 32 states.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from torch import Tensor, nn

import lfrtorch

SHAPES = (32, 200), (8, 2000)
UNITS = 16


def lfr() -> nn.Module:
    """An LFR in float32."""
    static = lfrtorch.Network(2, 2, 10)
    return lfrtorch.LFR(lfrtorch.LFRCell(1, 1, 4, 2, 2, static))


def layers() -> dict[str, Callable[[Tensor], Any]]:
    """All layers by name."""
    found: dict[str, Callable[[Tensor], Any]] = {"LFR": lfr()}
    found["LFR, torch.compile"] = torch.compile(lfr())
    for kind in (nn.RNN, nn.GRU, nn.LSTM):
        found[f"nn.{kind.__name__}({UNITS})"] = kind(1, UNITS, batch_first=True)
    try:
        from tsfast.models import NeuralStateSpace  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("tsfast is not installed")
    else:
        found["tsfast NeuralStateSpace(4)"] = NeuralStateSpace(1, 1, 4)
    try:
        from neural_ssm import DeepSSM  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("neural-ssm is not installed")
    else:
        found["neural-ssm DeepSSM"] = DeepSSM(1, 1)
    return found


def once(layer: Callable[[Tensor], Any], u: Tensor) -> float:
    """Seconds of one pass."""
    begin = time.perf_counter()
    y = layer(u)
    y = y if isinstance(y, Tensor) else y[0]
    y.square().mean().backward()
    return time.perf_counter() - begin


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    torch.manual_seed(0)
    found = layers()
    for R, T in SHAPES:
        u = torch.randn(R, T, 1)
        for layer in found.values():  # compile
            once(layer, u)
        seconds = {name: [0.0] * rounds for name in found}
        for i in range(rounds):
            for name, layer in found.items():
                seconds[name][i] = once(layer, u)
        least = median(seconds["LFR"])
        print(f"\n| {R} records of {T} samples | ms | to the LFR |\n| --- | --- | --- |")
        for name, each in seconds.items():
            print(f"| {name} | {1e3 * median(each):.1f} | {median(each) / least:.2f} |")


if __name__ == "__main__":
    main()
