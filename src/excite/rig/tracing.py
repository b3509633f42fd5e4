"""Functions for JAX written down as programs for NumPy, see `rig.program`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend.core import Jaxpr, Literal

from .program import OPERATIONS, Operation, Program, function_of

_INNER = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr",
          "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "remat": "jaxpr",
          "checkpoint": "jaxpr"}  # fmt: skip
_TAKES = {
    "integer_pow": ("y",), "convert_element_type": ("new_dtype",),
    "broadcast_in_dim": ("shape", "broadcast_dimensions"), "reshape": ("new_sizes",),
    "squeeze": ("dimensions",), "transpose": ("permutation",), "concatenate": ("dimension",),
    "stack": ("axis",), "slice": ("start_indices", "limit_indices", "strides"),
    "reduce_sum": ("axes",), "reduce_max": ("axes",), "reduce_min": ("axes",),
    "dot_general": ("dimension_numbers",), "iota": ("dtype", "shape", "dimension"),
}  # fmt: skip

_SAME = "convert_element_type", "copy", "stop_gradient", "squeeze", "reshape", "broadcast_in_dim"
"""Operations that change nothing where the array keeps its shape and type."""


def program_of(function: Callable[..., jax.Array], *examples: np.ndarray) -> Program:
    """The program of a function, for arrays of the shapes of these examples.

    Raises:
        ValueError: for a function with an operation that programs do not have.
    """
    closed = jax.make_jaxpr(function)(*examples)
    writer = _Writer(len(examples))
    inputs = list(range(len(examples)))
    constants = [writer.constant(np.asarray(c)) for c in closed.consts]
    (result,) = writer.written(closed.jaxpr, constants, inputs)
    return writer.program(result)


@dataclass
class _Writer:
    num_inputs: int
    constants: dict[int, np.ndarray] = field(default_factory=dict)
    operations: list[Operation] = field(default_factory=list)
    done: dict[str, int] = field(default_factory=dict)
    cuts: dict[int, Operation] = field(default_factory=dict)
    count: int = 0

    def __post_init__(self) -> None:
        self.count = self.num_inputs

    def new(self) -> int:
        self.count += 1
        return self.count - 1

    def constant(self, value: np.ndarray) -> int:
        task = repr((value.dtype, value.shape, value.tobytes()))
        if task not in self.done:
            self.done[task] = self.new()
            self.constants[self.done[task]] = value
        return self.done[task]

    def written(self, jaxpr: Jaxpr, constants: Sequence[int], inputs: Sequence[int]) -> list[int]:
        """Writes down all operations; returns the values of the outputs."""
        places: dict[Any, int] = dict(
            zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True)
        )

        def place(atom: Any) -> int:
            is_literal = isinstance(atom, Literal)
            return self.constant(np.asarray(atom.val)) if is_literal else places[atom]

        for equation in jaxpr.eqns:
            takes = [place(atom) for atom in equation.invars]
            name, after = equation.primitive.name, equation.outvars[0].aval
            is_same = name in _SAME and equation.invars[0].aval == after
            gives = takes if is_same else self._equation(name, takes, equation.params)
            if len(gives) < len(equation.outvars):  # no operation that programs have
                gives = gives * len(equation.outvars)
            places |= dict(zip(equation.outvars, gives, strict=False))
        return [place(atom) for atom in jaxpr.outvars]

    def _equation(self, name: str, takes: list[int], params: dict[str, Any]) -> list[int]:
        if name in _INNER:
            inner = params[_INNER[name]]
            constants = [self.constant(np.asarray(c)) for c in inner.consts]
            return self.written(inner.jaxpr, constants, takes)
        if name == "scan":
            return self._scan(takes, params)
        settings = {word: _plain(params[word]) for word in _TAKES.get(name, ())}
        cut = self.cuts.get(takes[0]) if name == "squeeze" else None
        if cut is not None:  # one row or column, in one operation
            ends = cut.settings["start_indices"], cut.settings["limit_indices"]
            at: list[Any] = [[begin, end] for begin, end in zip(*ends, strict=True)]
            for axis in settings["dimensions"]:
                at[axis] = at[axis][0]
            return [self._operation("index", list(cut.takes), {"at": at})]
        return [self._operation(name, takes, settings)]

    def _operation(self, name: str, takes: list[int], settings: dict[str, Any]) -> int:
        """One operation; one of constants alone is done now, and none is done twice."""
        task = repr((name, takes, settings))
        if task in self.done:
            return self.done[task]
        if name in OPERATIONS and all(i in self.constants for i in takes):
            value = function_of(name, settings)(*(self.constants[i] for i in takes))
            number = self.constant(np.asarray(value))
        else:
            number = self.new()
            operation = Operation(name, tuple(takes), number, settings)
            self.operations.append(operation)
            if name == "slice" and set(settings["strides"] or [1]) == {1}:
                self.cuts[number] = operation
        self.done[task] = number
        return number

    def _scan(self, takes: list[int], params: dict[str, Any]) -> list[int]:
        """A loop of known length, written out."""
        inner, num_consts, num_carry = params["jaxpr"], params["num_consts"], params["num_carry"]
        own = [self.constant(np.asarray(c)) for c in inner.consts]
        fixed, carry = takes[:num_consts], takes[num_consts : num_consts + num_carry]
        series, collected = takes[num_consts + num_carry :], []
        steps = range(params["length"])
        for i in reversed(steps) if params["reverse"] else steps:
            rows = [self._operation("row", [x], {"i": i}) for x in series]
            given = self.written(inner.jaxpr, own, [*fixed, *carry, *rows])
            carry = given[:num_carry]
            collected.append(given[num_carry:])
        if params["reverse"]:
            collected.reverse()
        series = zip(*collected, strict=True)
        stacked = [self._operation("stack", list(rows), {"axis": 0}) for rows in series]
        return [*carry, *stacked]

    def program(self, result: int) -> Program:
        """What the result needs, numbered anew."""
        needed, kept = {result}, []
        for operation in reversed(self.operations):
            if operation.gives in needed:
                kept.append(operation)
                needed |= set(operation.takes)
        if unknown := sorted({o.name for o in kept} - OPERATIONS):
            raise ValueError(
                f"the plant's equations use {', '.join(unknown)}, which a guard cannot run "
                "without JAX"
            )
        constants = {i: value for i, value in self.constants.items() if i in needed}
        return Program(self.num_inputs, constants, tuple(reversed(kept)), result)


def _plain(value: Any) -> Any:
    """A setting, JSON-ready."""
    if isinstance(value, tuple | list | range):
        return [_plain(v) for v in value]
    if isinstance(value, np.integer):
        return int(value)
    if value is None or isinstance(value, int | float | str | bool):
        return value
    return str(np.dtype(value))
