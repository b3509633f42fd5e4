"""A function of arrays as a list of NumPy operations, so that it runs without JAX.

A plant is written for JAX. What a guard needs of it, one sample ahead and the outputs, is
written down once as a `Program`, kept in a policy's file, and run by NumPy on a laboratory
computer. A program from a file can only do arithmetic on arrays.
"""

from __future__ import annotations

import base64
import contextlib
import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from operator import itemgetter, methodcaller
from typing import Any, Self

import numpy as np

Numpy = Callable[..., Any]

_LONGEST = 10_000_000  # bytes of a program: a file of a few bytes cannot fill the memory
_MOST_INPUTS = 10


def _integer_pow(y: int) -> Numpy:
    if y == 2:
        return np.square
    return lambda x: np.power(x, y) if y > 0 else 1.0 / np.power(x, -y)


def _broadcast_in_dim(shape: list[int], broadcast_dimensions: list[int]) -> Numpy:
    def broadcast(x: np.ndarray) -> np.ndarray:
        ones = [1] * len(shape)
        for axis, size in zip(broadcast_dimensions, np.shape(x), strict=True):
            ones[axis] = size
        return np.broadcast_to(np.reshape(x, ones), shape)

    return broadcast


def _stack(axis: int) -> Numpy:
    def stacked(*parts: np.ndarray) -> np.ndarray:  # np.stack takes four times as long
        whole = np.array(parts)
        return whole.transpose((*range(1, axis + 1), 0, *range(axis + 1, whole.ndim)))

    return stacked if axis else lambda *parts: np.array(parts)


def _dot_general(dimension_numbers: list[list[list[int]]]) -> Numpy:
    (of_a, of_b), (batch_a, batch_b) = dimension_numbers

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        if not (batch_a or batch_b):
            return np.tensordot(a, b, (of_a, of_b))
        names_a, names_b = list(range(np.ndim(a))), list(range(20, 20 + np.ndim(b)))
        for i, j in zip([*of_a, *batch_a], [*of_b, *batch_b], strict=True):
            names_b[j] = names_a[i]
        batch = [names_a[i] for i in batch_a]
        used = {*batch, *(names_a[i] for i in of_a)}
        rest = [n for n in (*names_a, *names_b) if n not in used]
        return np.einsum(a, names_a, b, names_b, [*batch, *rest])

    return dot


_PLAIN: Mapping[str, Numpy] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "pow": np.power, "rem": np.fmod, "abs": np.abs,
    "sign": np.sign, "floor": np.floor, "ceil": np.ceil, "sqrt": np.sqrt, "square": np.square,
    "exp": np.exp, "exp2": np.exp2, "expm1": np.expm1, "log": np.log, "log1p": np.log1p,
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "atan2": np.arctan2, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh,
    "asinh": np.arcsinh, "acosh": np.arccosh, "atanh": np.arctanh, "lt": np.less,
    "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal,
    "ne": np.not_equal, "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
    "is_finite": np.isfinite, "copy": np.asarray, "stop_gradient": np.asarray,
    "rsqrt": lambda x: 1.0 / np.sqrt(x),
    "logistic": lambda x: 1.0 / (1.0 + np.exp(-x)),
    "clamp": lambda low, x, high: np.clip(x, low, high),
    "select_n": lambda which, first, second: np.where(which, second, first),
}  # fmt: skip

_WITH_SETTINGS: Mapping[str, Callable[..., Numpy]] = {
    "integer_pow": _integer_pow,
    "convert_element_type": lambda new_dtype: methodcaller("astype", _dtype(new_dtype)),
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda new_sizes: methodcaller("reshape", new_sizes),
    "squeeze": lambda dimensions: methodcaller("squeeze", tuple(dimensions)),
    "transpose": lambda permutation: methodcaller("transpose", permutation),
    "concatenate": lambda dimension: lambda *parts: np.concatenate(parts, dimension),
    "stack": _stack,
    "slice": lambda start_indices, limit_indices, strides: itemgetter(
        tuple(map(slice, start_indices, limit_indices, strides or [1] * len(start_indices)))
    ),
    "row": lambda i: itemgetter(i),
    "index": lambda at: itemgetter(tuple(i if isinstance(i, int) else slice(*i) for i in at)),
    "reduce_sum": lambda axes: partial(np.sum, axis=tuple(axes)),
    "reduce_max": lambda axes: partial(np.max, axis=tuple(axes)),
    "reduce_min": lambda axes: partial(np.min, axis=tuple(axes)),
    "dot_general": _dot_general,
    "iota": lambda dtype, shape, dimension: (
        lambda: np.asarray(np.indices(shape)[dimension], _dtype(dtype))
    ),
}

OPERATIONS = frozenset((*_PLAIN, *_WITH_SETTINGS))
"""By the names of JAX; the settings of each are named as there."""


def function_of(name: str, settings: Mapping[str, Any]) -> Numpy:
    """The function of arrays that an operation is.

    Raises:
        KeyError, TypeError: for an operation or for settings that do not exist.
    """
    return _PLAIN[name] if name in _PLAIN else _WITH_SETTINGS[name](**settings)


@dataclass(frozen=True)
class Operation:
    """One operation on values, which are known by their numbers.

    Attributes:
        name: of `OPERATIONS`.
        takes: values.
        gives: value.
        settings: by name, JSON-ready.
    """

    name: str
    takes: tuple[int, ...]
    gives: int
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class Program:
    """A function of some arrays that gives one array.

    Attributes:
        num_inputs: arrays it takes; they are values 0, 1, ...
        constants: by value.
        operations: in their order.
        result: value.
    """

    num_inputs: int
    constants: Mapping[int, np.ndarray]
    operations: tuple[Operation, ...]
    result: int

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        """The function, in double precision."""
        known, steps, result = self._steps
        values = [*arrays, *known]
        for function, takes in steps:
            values.append(function(*[values[i] for i in takes]))
        return values[result]

    @cached_property
    def _steps(self) -> tuple[list[np.ndarray], list[tuple[Numpy, list[int]]], int]:
        """Constants, what is done with inputs and constants in turn, and the result's place."""
        place = {number: i for i, number in enumerate([*range(self.num_inputs), *self.constants])}
        steps = []
        for o in self.operations:
            function, takes = function_of(o.name, o.settings), [place[i] for i in o.takes]
            if isinstance(function, np.ufunc) and len(takes) != function.nin:
                raise TypeError(f"{o.name} of {len(takes)} values")
            steps.append((function, takes))
            place[o.gives] = len(place)
        return list(self.constants.values()), steps, place[self.result]

    def __getstate__(self) -> dict[str, Any]:
        """Its fields; `_steps` cannot be pickled, and is made again."""
        return {name: value for name, value in vars(self).items() if name != "_steps"}

    def to_text(self) -> str:
        """The program in few letters: its JSON, compressed."""
        whole = json.dumps(self.to_dict(), separators=(",", ":")).encode()
        return base64.b64encode(zlib.compress(whole, 9)).decode()

    @classmethod
    def from_text(cls, text: str) -> Self:
        """The program that `to_text` wrote.

        Raises:
            ValueError: for another text.
        """
        try:
            reader = zlib.decompressobj()
            whole = reader.decompress(base64.b64decode(text, validate=True), _LONGEST)
            data = json.loads(whole)
        except (ValueError, TypeError, zlib.error) as error:
            raise ValueError(f"a plant's program is damaged ({error!r})") from None
        return cls.from_dict(data)

    def to_dict(self) -> dict[str, Any]:
        """The program as JSON-ready data."""
        constants = {
            str(i): {"dtype": str(c.dtype), "shape": list(c.shape), "values": c.ravel().tolist()}
            for i, c in self.constants.items()
        }
        return {
            "num_inputs": self.num_inputs,
            "constants": constants,
            "operations": [[o.name, o.takes, o.gives, o.settings] for o in self.operations],
            "result": self.result,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The program that `to_dict` wrote.

        Raises:
            ValueError: for data of another form.
        """
        try:
            constants = {
                int(i): np.array(c["values"], _dtype(c["dtype"])).reshape(c["shape"])
                for i, c in data["constants"].items()
            }
            operations = tuple(
                Operation(_known(name), tuple(takes), gives, dict(settings))
                for name, takes, gives, settings in data["operations"]
            )
            read = cls(int(data["num_inputs"]), constants, operations, int(data["result"]))
            if not 0 <= read.num_inputs <= _MOST_INPUTS:
                raise ValueError(f"a plant's program has {read.num_inputs} inputs")
            read._steps  # noqa: B018  what is damaged is found now
            return read
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"a plant's program is damaged ({error!r})") from None


def _known(name: str) -> str:
    if name not in OPERATIONS:
        raise ValueError(f"a plant's program has the unknown operation {name!r}")
    return name


def _dtype(name: str) -> str:
    with contextlib.suppress(TypeError):
        if np.dtype(name).kind in "biuf":
            return name
    raise ValueError(f"a plant's program has numbers of the unknown type {name!r}")
