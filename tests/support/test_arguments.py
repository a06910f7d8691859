"""Arguments of other types than their hints name end in a message."""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import ArrayLike

import lfrtorch
from lfrtorch import InputError, analysis
from lfrtorch._support.arguments import is_of, typed, wanted
from lfrtorch.fitting.trainer import Trainer

FUNCTIONS = [
    found
    for module in (lfrtorch, analysis)
    for name in module.__all__
    if inspect.isfunction(found := getattr(module, name))
]


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (bool, [True, np.True_], [1, None, "true"]),
        (int | None, [1, np.int64(2), None], [True, 0.5, "1"]),
        (float | None, [1, 0.5, np.float32(2)], ["1", True, 1j]),
        (Literal["a", "b"], ["a", np.str_("b")], ["c", np.array(["a"]), ["a"], None]),
        (Literal[0, 1], [0, np.int64(1)], [True, 0.0, "0"]),
        (str | Path, ["x", Path("x")], [b"x", 1]),
        (Sequence[int], [[1], (), range(3), np.arange(3)], [1, "1", [0.5], {1}, np.zeros(1)]),
        (Sequence[str], [["a"]], ["a", [1], np.array(["a"])]),
        (Iterable[Any], [iter([1]), [1]], [1, "text"]),
        (Mapping[str, int], [{}, {"a": 1}], [[], "a"]),
        (Callable[[], int], [lambda: 1, int], [1, "f"]),
        (Trainer, [lfrtorch.Adam(), lfrtorch.LevenbergMarquardt()], ["adam", None, lfrtorch.Adam]),
        (Any, [1, None], []),
        (ArrayLike, [1, [1.0], np.zeros(3)], []),
    ],
)
def test_values_of_the_hint_pass_alone(hint: Any, good: list[Any], bad: list[Any]):
    assert [value for value in good if not is_of(value, hint)] == []
    assert [value for value in bad if is_of(value, hint)] == []


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        (bool, "True or False"),
        (Literal["a", "b"] | None, "'a', 'b' or None"),
        (ArrayLike | None, "an array or None"),
        (str | Path | Sequence[str | Path], "a text, a Path or several of them"),
        (lfrtorch.FRF, "an FRF"),
        (Sequence[lfrtorch.Model], "a list (each: a Model)"),
    ],
)
def test_what_to_give_is_said(hint: Any, said: str):
    assert wanted(hint) == said


def test_methods_and_classes_are_watched():
    @typed()
    class Drawn:
        def __init__(self, grid: bool) -> None:
            self.grid = grid

        @typed()
        def line(self, *names: str, wide: bool = False, **more: Any) -> bool:
            return wide

    assert Drawn(grid=True).line("a", wide=True, other=1)
    with pytest.raises(InputError, match="grid is 1; give True or False"):
        Drawn(1)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="wide is 'no'; give True or False"):
        Drawn(True).line(wide="no")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="grid"):
        Drawn()  # pyright: ignore[reportCallIssue]


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_public_functions_refuse_objects_of_no_use(function: Callable[..., Any]):
    required = [
        name for name, parameter in inspect.signature(function).parameters.items()
        if parameter.default is inspect.Parameter.empty
        and parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]  # fmt: skip
    with pytest.raises(InputError, match=r"is <object object .*>; give "):
        function(**dict.fromkeys(required, object()))


def test_a_long_value_is_cut_off():
    with pytest.raises(InputError) as found:
        lfrtorch.rmse([0.123] * 10_000, np.zeros(1))  # pyright: ignore[reportArgumentType]
    assert len(str(found.value)) < 200
    with pytest.raises(InputError, match=r"nz is array.* \.\.\. .*give a whole number") as found:
        lfrtorch.Network(np.zeros((300, 1)), 1, 1)  # pyright: ignore[reportArgumentType]
    assert len(str(found.value)) < 1000
