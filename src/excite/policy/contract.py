"""`Policy`: a network and the contract under which it may excite a plant.

A policy is a network, with or without a memory, and the layout of what it observes, in one
safetensors file: the weights as tensors, the contract (plant, layout, provenance) as JSON in the
header. It is read and run with NumPy alone. One step of a policy, from window and
measurement to the input, is `respond`: `xp` is NumPy on a rig, and `jax.numpy` in
training and simulation. Nothing is unpickled.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..description import Input, Output, PlantDescription, Spread, SpreadLike
from ..files import (
    checksum_of,
    require_new_file,
    tensors_from_bytes,
    tensors_to_bytes,
    write_bytes,
)

FORMAT = "excite policy 1"
_MAX_COUNT = 2**31  # of samples, in a file of unknown origin

AnyArray: TypeAlias = Any
"""A NumPy or a JAX array."""

Weights: TypeAlias = tuple[tuple[AnyArray, AnyArray], ...]
"""Matrix [out, in] and bias [out] of every layer. Of a policy with a memory, the first are its
unit: gates from the observation and from the memory, or the encoder of a sample, which for
attention is followed by queries, keys and values."""


@dataclass(frozen=True)
class Layout:
    """What a policy observes: Eq. 2 of Langschwert et al., for any plant.

    The last `window` measurements over `output_scale`, the last `window` inputs over the
    input limits, oldest first, and k / num_steps. The newest input is that of the previous
    step. Samples before the first are zero. Beyond Eq. 2, sine and cosine of clocks that
    run with k may follow.

    Attributes:
        window: number of samples.
        num_steps: T, steps of the experiment the policy was made for.
        output_scale: y_max of each output, in its unit.
        input_middle, input_half: middle of each input's limits, and the largest distance
            from it: half their width, or less.
        clocks: frequencies of the clocks, in cycles a step, at most one half.
        memory: numbers in which the policy keeps what it has seen.
        memory_kind: how: `gru`, by a gated recurrent unit; `sum`, as the sum of the encoded
            samples; or `attention`, by self-attention over the samples of the window.
    """

    window: int
    num_steps: int
    output_scale: tuple[float, ...]
    input_middle: tuple[float, ...]
    input_half: tuple[float, ...]
    clocks: tuple[float, ...] = ()
    memory: int = 0
    memory_kind: str = "gru"

    def __post_init__(self) -> None:
        """Raises ValueError for a kind of memory that does not exist, or of none."""
        if self.memory_kind not in MEMORIES:
            raise ValueError(
                f"memory_kind must be one of {', '.join(MEMORIES)}: got {self.memory_kind!r}"
            )
        if self.memory_kind != "gru" and not self.memory:
            raise ValueError(NO_MEMORY)

    @classmethod
    def of(
        cls,
        description: PlantDescription,
        window: int = 80,
        num_steps: int = 500,
        memory: int = 0,
        memory_kind: str = "gru",
    ) -> Layout:
        """The layout for a plant, scaled by its outputs' scales and its input limits.

        Raises:
            ValueError: where a length is below one, or the memory's below zero; for a kind of
                memory that does not exist, or of none.
        """
        if memory < 0:
            raise ValueError(f"memory must not be negative: got {memory}")
        if window < 1 or num_steps < 1:
            raise ValueError(
                f"window and num_steps must be at least 1: got {window} and {num_steps}"
            )
        return cls(
            window=window,
            num_steps=num_steps,
            output_scale=tuple(o.scale for o in description.outputs),
            input_middle=tuple((i.lower + i.upper) / 2 for i in description.inputs),
            input_half=tuple((i.upper - i.lower) / 2 for i in description.inputs),
            memory=memory,
            memory_kind=memory_kind,
        )

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return self.progress + 1 + 2 * len(self.clocks)

    @property
    def progress(self) -> int:
        """Where an observation has k / num_steps: after the window."""
        return self.window * (len(self.output_scale) + len(self.input_half))

    @property
    def newest(self) -> tuple[int, ...]:
        """Where an observation has the newest sample: the measurement, and the input before it."""
        first = self.window * len(self.output_scale)
        outputs = range(first - len(self.output_scale), first)
        return (*outputs, *range(self.progress - len(self.input_half), self.progress))

    @property
    def size_beside_memory(self) -> int:
        """Numbers in `beside_memory`."""
        used = self.progress - len(self.newest) if self.memory_kind == "attention" else 0
        return self.size - used

    @cached_property
    def beside_memory(self) -> np.ndarray:
        """Where an observation has what the layers after a memory see too.

        All of it; with attention, which has read the window, the newest sample and the time.
        """
        if self.memory_kind == "attention":
            return np.array([*self.newest, *range(self.progress, self.size)])
        return np.arange(self.size)

    @property
    def unit(self) -> tuple[tuple[int, int], ...]:
        """Shapes of the matrices of the memory's unit; of an encoder, -1 is a free width."""
        m, sample = self.memory, len(self.newest)
        gates = (3 * m, self.size), (3 * m, m)
        encoder = (-1, sample), (m, -1)
        units = {"gru": gates, "sum": encoder, "attention": (*encoder, (3 * m, m))}
        return units[self.memory_kind] if m else ()


class Window(NamedTuple):
    """The last measurements and inputs, scaled, oldest first, and what the policy remembers."""

    outputs: AnyArray
    inputs: AnyArray
    memory: AnyArray = None


def empty_window(xp: ModuleType, layout: Layout) -> Window:
    """The window before the first measurement."""
    return Window(
        outputs=xp.zeros((layout.window, len(layout.output_scale))),
        inputs=xp.zeros((layout.window, len(layout.input_half))),
        memory=xp.zeros(layout.memory, xp.float32) if layout.memory else None,
    )


def with_measurement(xp: ModuleType, layout: Layout, window: Window, measured: AnyArray) -> Window:
    """The window after one more measurement, in output units."""
    newest = measured / xp.asarray(layout.output_scale)
    return window._replace(outputs=xp.concatenate([window.outputs[1:], newest[None]]))


def with_input(xp: ModuleType, layout: Layout, window: Window, input: AnyArray) -> Window:
    """The window after one more input was applied, in input units."""
    newest = (input - xp.asarray(layout.input_middle)) / xp.asarray(layout.input_half)
    return window._replace(inputs=xp.concatenate([window.inputs[1:], newest[None]]))


def observe(xp: ModuleType, layout: Layout, window: Window, k: AnyArray) -> AnyArray:
    """Observation of step k, in single precision: outputs, inputs, k / T, sines, cosines."""
    progress = xp.reshape(xp.asarray(k / layout.num_steps), (1,))
    parts = [xp.ravel(window.outputs), xp.ravel(window.inputs), progress]
    if layout.clocks:
        phase = 2 * math.pi * k * xp.asarray(layout.clocks)
        parts += [xp.sin(phase), xp.cos(phase)]
    return xp.concatenate(parts).astype(xp.float32)


def network(xp: ModuleType, weights: Weights, observation: AnyArray) -> AnyArray:
    """Hyperbolic tangents and a linear last layer."""
    x = observation
    for matrix, bias in weights[:-1]:
        x = xp.tanh(matrix @ x + bias)
    matrix, bias = weights[-1]
    return matrix @ x + bias


def forward(
    xp: ModuleType, weights: Weights, observation: AnyArray, if_not_finite: float = 0.0
) -> AnyArray:
    """Action in [-1, 1]: the network's output, clipped; `if_not_finite` for NaN or infinity."""
    action = network(xp, weights, observation)
    return xp.where(xp.isfinite(action), xp.clip(action, -1.0, 1.0), if_not_finite)


def gated(
    xp: ModuleType, layout: Layout, weights: Weights, memory: AnyArray, observation: AnyArray
) -> AnyArray:
    """The memory after one more observation: a gated recurrent unit.

    K. Cho et al., Learning phrase representations using RNN encoder-decoder, EMNLP 2014. The reset
    gate acts on what the memory's matrix made of the memory.
    """
    del layout
    (into, into_bias), (back, back_bias) = weights
    new = xp.split(into @ observation + into_bias, 3)
    old = xp.split(back @ memory + back_bias, 3)
    reset, keep = (0.5 + 0.5 * xp.tanh((new[i] + old[i]) / 2) for i in (0, 1))
    return (1 - keep) * xp.tanh(new[2] + reset * old[2]) + keep * memory


def added(
    xp: ModuleType, layout: Layout, weights: Weights, memory: AnyArray, observation: AnyArray
) -> AnyArray:
    """The memory after one more sample: the sum of all encoded ones, whatever their order.

    M. Zaheer et al., Deep sets, NeurIPS 2017. A sample is an input and the measurement after it;
    the measurement at step 0 follows no input and is not added. Encoded samples are divided by the
    root of num_steps, so that their sum has about the same size for experiments of any length.
    """
    encoded = network(xp, weights, observation[np.array(layout.newest)])
    is_sample = observation[layout.progress] > 0
    return memory + xp.where(is_sample, encoded / math.sqrt(layout.num_steps), 0.0)


def attended(
    xp: ModuleType, layout: Layout, weights: Weights, memory: AnyArray, observation: AnyArray
) -> AnyArray:
    """What self-attention reads in the samples of the window, whatever their order.

    A. Vaswani et al., Attention is all you need, NeurIPS 2017, with one head; added up and divided
    by the root of num_steps, as in `added`. With a window of num_steps these are all samples.
    """
    del memory
    outputs, inputs = xp.split(
        observation[: layout.progress], [layout.window * len(layout.output_scale)]
    )
    parts = [xp.reshape(part, (layout.window, -1)) for part in (outputs, inputs)]
    hidden, last, read = weights
    inner = xp.tanh(xp.concatenate(parts, axis=1) @ hidden[0].T + hidden[1][None])
    encoded = inner @ last[0].T + last[1][None]
    queries, keys, values = xp.split(encoded @ read[0].T + read[1][None], 3, axis=1)
    age = np.arange(layout.window, dtype=np.float32)[::-1] + np.float32(0.5)
    is_sample = age < observation[layout.progress] * layout.num_steps
    scores = queries @ keys.T / np.float32(math.sqrt(layout.memory))
    scores = xp.where(is_sample[None], scores, np.float32(-1e9))
    shares = xp.exp(scores - xp.max(scores, axis=1, keepdims=True))
    seen = encoded + shares / xp.sum(shares, axis=1, keepdims=True) @ values
    whole = xp.sum(xp.where(is_sample[:, None], seen, np.float32(0)), axis=0)
    return whole / np.float32(math.sqrt(layout.num_steps))


MEMORIES = {"gru": gated, "sum": added, "attention": attended}
"""Kinds of memory, each with the function that gives it after one more observation."""

NO_MEMORY = "memory_kind needs a memory: set memory, or leave memory_kind out"


def act(
    xp: ModuleType,
    layout: Layout,
    weights: Weights,
    window: Window,
    k: AnyArray,
    if_not_finite: float = 0.0,
) -> tuple[Window, AnyArray]:
    """Action in [-1, 1] of step k, for a window that ends with the measurement of step k.

    Returns:
        The window, with what the policy remembers of this step, and the action: the network's
        output, clipped; with a memory its hyperbolic tangent, which has a gradient everywhere.
        An observation that is not finite is not remembered.
    """
    seen = observe(xp, layout, window, k)
    if layout.memory:
        remembered = MEMORIES[layout.memory_kind]
        first = len(layout.unit)
        memory = remembered(xp, layout, weights[:first], window.memory, seen)
        beside = seen[layout.beside_memory]
        action = network(xp, weights[first:], xp.concatenate([memory, beside]))
        memory = xp.where(xp.all(xp.isfinite(seen)), memory, window.memory)
        action = xp.where(xp.isfinite(action), xp.tanh(action), if_not_finite)
        return window._replace(memory=memory), action
    return window, forward(xp, weights, seen, if_not_finite)


def scaled_action(xp: ModuleType, layout: Layout, action: AnyArray) -> AnyArray:
    """Input, in its unit, that an action in [-1, 1] stands for."""
    return xp.asarray(layout.input_middle) + xp.asarray(layout.input_half) * action


def respond(
    xp: ModuleType,
    layout: Layout,
    weights: Weights,
    window: Window,
    k: AnyArray,
    measured: AnyArray,
    if_not_finite: float = 0.0,
) -> tuple[Window, AnyArray]:
    """One step of a policy: the window with this measurement, and the input to apply.

    Call `with_input` afterwards with the input that was applied.

    Args:
        layout: what the policy observes.
        weights: of its network.
        window: with the inputs and measurements of all earlier steps.
        k: index of this step.
        measured: outputs, in their units.
        if_not_finite: action where the network's output is NaN or infinite.

    Returns:
        The window, and the input in its unit, in double precision.
    """
    window = with_measurement(xp, layout, window, measured)
    window, action = act(xp, layout, weights, window, k, if_not_finite)
    return window, scaled_action(xp, layout, action.astype(float))


@dataclass(frozen=True, repr=False)
class Policy:
    """A trained network and its contract.

        >>> import excite as ex
        >>> ex.read_policy("aero2").plant.name
        'aero2'

    Attributes:
        plant: description of the plant it was trained on.
        layout: what it observes.
        weights: float32 matrices and biases.
        provenance: how it was made, JSON-ready.
        certificate: what a search for the least safe plant found (`excite falsify`), JSON-ready.
        guard: what a guard on a rig needs (`excite.rig.guard`), JSON-ready.
    """

    plant: PlantDescription
    layout: Layout
    weights: Weights
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    certificate: Mapping[str, Any] | None = None
    guard: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        layers = tuple(
            (np.asarray(matrix, np.float32), np.asarray(bias, np.float32))
            for matrix, bias in self.weights
        )
        object.__setattr__(self, "weights", layers)
        _check_layers(layers, self.layout)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Action in [-1, 1] for one observation.

        Raises:
            ValueError: for an observation of another size, and for a policy with a memory, whose
                action depends on earlier observations, too.
        """
        if self.layout.memory:
            raise ValueError(
                f"this policy has a memory of {self.layout.memory} numbers: its action depends on "
                "earlier observations, too (excite.policy.respond)"
            )
        if np.shape(observation) != (self.layout.size,):
            raise ValueError(
                f"an observation of this policy has shape {(self.layout.size,)}; "
                f"got {np.shape(observation)}"
            )
        return forward(np, self.weights, observation)

    def __repr__(self) -> str:
        """Plant, what is observed, how it was trained, and the hash."""
        layout, made = self.layout, self.provenance
        layers = self.weights[len(layout.unit) :]
        widths = [layout.size, *[layout.memory] * bool(layout.memory), *(len(b) for _, b in layers)]
        words = [f"{word} {made[word]}" for word in ("method", "agent", "study") if word in made]
        claim = textwrap.fill(self.claim, 80, initial_indent="  ", subsequent_indent="    ")
        return (
            f"Policy for the plant {self.plant.name}\n"
            f"  observes {layout.window} samples, for {layout.num_steps} steps of "
            f"{self.plant.dt:g} s; network {'-'.join(map(str, widths))}\n"
            f"  trained by {', '.join(words) or 'unknown'}\n"
            f"{claim}\n"
            f"{'  with a guard (excite run --guard)' + chr(10) if self.guard else ''}"
            f"  hash {self.hash}"
        )

    @property
    def hash(self) -> str:
        """SHA-256 of contract and weights, without certificate and guard: what the policy does."""
        return str(checksum_of(self.certified(None).to_bytes()))

    @property
    def claim(self) -> str:
        """What a search for violations found, with its conditions, as a sentence."""
        c = self.certificate
        if c is None:
            return "no certificate: no search for violations (excite falsify)"
        largest, with_noise = (
            "a simulation diverged"
            if c[name] is None
            else f"{shown_nearness(c[name])} of the critical level"
            for name in ("nearness", "noise_nearness")
        )
        box = ", ".join(f"{n} {a:.3g} to {b:.3g}" for n, (a, b) in c["uncertainty"].items())
        plants = f"plants {c['plant']}" if "plant" in c else "plants"
        where = " on the simulated rig" if c.get("rig") else ""
        where += " behind the safety filter" if c.get("filter") else ""
        where += f" and {c['coast']} samples after each" if c.get("coast") else ""
        return (
            f"largest output found in {c['experiments']:,} experiments{where}: {largest}, "
            f"{with_noise} with noise searched within {c['noise_bound']:g} sd; {plants}: {box}; "
            "found, not proved"
        )

    def certified(
        self, certificate: Mapping[str, Any] | None, guard: Mapping[str, Any] | None = None
    ) -> Policy:
        """The same policy with another certificate and guard."""
        return dataclasses.replace(self, certificate=certificate, guard=guard)

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the policy's file (.safetensors); `read_policy` reads it back.

        Raises:
            ValueError: one sentence where it may not or cannot be written.
        """
        path = Path(path)
        if path.suffix != ".safetensors":
            raise ValueError(f"{path}: policy files end in .safetensors")
        require_new_file(path, overwrite)
        write_bytes(path, self.to_bytes())

    def to_bytes(self) -> bytes:
        """Content of the policy's file; `from_bytes` reads it back."""
        contract = {
            "plant": self.plant.to_dict(),
            "plant_hash": self.plant.hash,
            "layout": _layout_data(self.layout),
            "provenance": dict(self.provenance),
        }
        if self.certificate is not None:
            contract["certificate"] = dict(self.certificate)
        if self.guard is not None:
            contract["guard"] = dict(self.guard)
        tensors = {
            f"{i}.{part}": array
            for i, layer in enumerate(self.weights)
            for part, array in zip(("weight", "bias"), layer, strict=True)
        }
        return tensors_to_bytes(tensors, FORMAT, contract)

    @classmethod
    def from_bytes(cls, content: bytes, where: str = "policy") -> Policy:
        """The policy in the content of a file.

        Raises:
            ValueError: one sentence for content that is truncated, changed, of another version,
                inconsistent, or with numbers that are not finite.
        """
        tensors, contract = tensors_from_bytes(content, FORMAT, where)
        try:
            numbers: dict[str, Any] = {  # JSON has lists
                k: tuple(v) if isinstance(v, list) else v for k, v in contract["layout"].items()
            }
            layout = Layout(**numbers)
            plant = PlantDescription.from_dict(contract["plant"])
            if contract["plant_hash"] != plant.hash:
                raise ValueError(
                    "the plant in the contract does not have the hash that was written"
                )
            num_layers = (len(tensors) + 1) // 2
            weights = tuple(
                (tensors[f"{i}.weight"], tensors[f"{i}.bias"]) for i in range(num_layers)
            )
            if any(array.dtype != np.float32 for array in tensors.values()):
                raise ValueError("weights are not in single precision")
            _check_layout(layout, plant)
            certificate = contract.get("certificate")
            if certificate is not None:
                _check_certificate(certificate)
            made, guard = dict(contract["provenance"]), contract.get("guard")
            return cls(plant, layout, weights, made, certificate, guard)
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"{where}: incomplete or malformed contract ({error})") from None
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None


def _layout_data(layout: Layout) -> dict[str, Any]:
    """The layout as JSON-ready data, without memory and its kind where they are the default ones.

    So the hashes of older policies stay valid.
    """
    unused = ("memory", 0), ("memory_kind", "gru")
    return {k: v for k, v in dataclasses.asdict(layout).items() if (k, v) not in unused}


def _check_layout(layout: Layout, plant: PlantDescription) -> None:
    numbers = (*layout.output_scale, *layout.input_middle, *layout.input_half)
    whole = layout.window, layout.num_steps, layout.memory
    if not all(type(n) is int and n < _MAX_COUNT for n in whole):
        raise ValueError("window, num_steps and memory of a layout are whole numbers")
    usual = Layout.of(plant, *whole, layout.memory_kind)
    free = {n: getattr(layout, n) for n in ("output_scale", "input_half", "clocks")}
    if layout != dataclasses.replace(usual, **free) or not all(math.isfinite(n) for n in numbers):
        raise ValueError("the observation layout does not belong to the policy's plant")
    if len(layout.input_half) != len(plant.inputs) or not all(
        0 < half <= whole for half, whole in zip(layout.input_half, usual.input_half, strict=True)
    ):
        raise ValueError("the layout's inputs go beyond the limits of the policy's plant")
    if not all(0 < n <= 0.5 for n in layout.clocks):
        raise ValueError("the clocks of a layout are above 0 and at most half a cycle a step")
    if len(layout.output_scale) != len(plant.outputs) or min(layout.output_scale) <= 0:
        raise ValueError("the observation layout does not belong to the policy's plant")


def shown_nearness(value: float | None) -> str:
    """A largest output over its critical level, as text."""
    if value is None or not math.isfinite(value):
        return "diverged"
    return f"{value:.3f}" if value <= _MOST_SHOWN else f"> {_MOST_SHOWN}"


_MOST_SHOWN = 1000


def _check_certificate(certificate: Any) -> None:
    """Raises an error for a certificate without its numbers."""
    ranges = [tuple(ends) for ends in certificate["uncertainty"].values()]
    whole = [
        certificate["experiments"],
        certificate.get("num_steps", 0),
        certificate.get("coast", 0),
    ]
    sizes = [certificate[name] for name in ("nearness", "noise_nearness")]  # None for infinity
    numbers = [
        *itertools.chain(*ranges),
        certificate["noise_bound"],
        *(size for size in sizes if size is not None),
    ]
    if not (
        isinstance(certificate["plant_hash"], str)
        and isinstance(certificate.get("plant", ""), str)
        and all(len(ends) == 2 for ends in ranges)
        and all(type(n) in (int, float) and abs(n) <= sys.float_info.max for n in numbers)
        and all(type(n) is int and 0 <= n < _MAX_COUNT for n in whole)
    ):
        raise ValueError("its certificate is malformed")


def _check_layers(weights: Weights, layout: Layout) -> None:
    """Raises ValueError where the layers do not fit each other, the layout or the plant."""
    width, first = layout.memory + layout.size_beside_memory, len(layout.unit)
    if layout.memory:
        inner = weights[0][1].size if weights else 0
        matrices = [[inner if n == -1 else n for n in matrix] for matrix in layout.unit]
        shapes = [tuple(shape) for matrix in matrices for shape in (matrix, matrix[:1])]
        if [part.shape for layer in weights[:first] for part in layer] != shapes:
            raise ValueError(f"the unit of a memory of {layout.memory} numbers has other weights")
    if len(weights) <= first:
        raise ValueError("a policy needs at least one layer")
    for matrix, bias in weights[:first]:
        if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(bias))):
            raise ValueError("the unit of the memory has weights that are not finite")
    for i, (matrix, bias) in enumerate(weights[first:]):
        if matrix.ndim != 2 or matrix.shape[1] != width or bias.shape != matrix.shape[:1]:
            raise ValueError(
                f"layer {i} has weights {matrix.shape} and biases {bias.shape}; "
                f"{width} numbers enter it"
            )
        if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(bias))):
            raise ValueError(f"layer {i} has weights that are not finite")
        width = matrix.shape[0]
    if width != (num_inputs := len(layout.input_half)):
        raise ValueError(f"the last layer gives {width} numbers for {num_inputs} inputs")


def mismatch(policy: Policy, plant: PlantDescription) -> str | None:
    """A warning if the plant is not that of training, but may be excited; else None.

    Raises:
        ValueError: one sentence if it may not be excited: other names, units, input
            limits, levels or sampling time.
    """
    trained = policy.plant
    _require_same("inputs", trained.inputs, plant.inputs, ("unit", "lower", "upper"))
    levels = ("unit", "warning_level", "critical_level")
    _require_same("outputs", trained.outputs, plant.outputs, levels)
    if not math.isclose(trained.dt, plant.dt, rel_tol=1e-9):
        raise ValueError(
            f"the policy was trained for a sampling time of {trained.dt:g} s; "
            f"{plant.name!r} has {plant.dt:g} s"
        )
    if trained.hash == plant.hash:
        return None
    if trained.name != plant.name:
        return f"the policy was trained on {trained.name!r}, not on {plant.name!r}"
    return (
        f"the policy was trained on another {trained.name!r} (hash {trained.hash[:8]}) than this "
        "one, with other constants, nominal values or noise"
    )


def guard_of(policy: Policy, plant: PlantDescription) -> Mapping[str, Any]:
    """The guard in a policy's file, for `excite.rig.guard`.

    Raises:
        ValueError: where there is none for this plant.
    """
    if policy.guard is None:
        raise ValueError(
            "the policy has no guard ('excite falsify --guard --certify FILE' makes one)"
        )
    if policy.plant.hash != plant.hash:
        raise ValueError(f"the policy's guard is not for this {plant.name!r}")
    return policy.guard


def require_certified(
    policy: Policy, plant: PlantDescription, spread: SpreadLike, filtered: bool = False
) -> None:
    """Raises ValueError where no certificate says that a search found the policy safe.

    Args:
        policy: to be played.
        plant: on which the search must have been made.
        spread: of its parameters, which the search must have covered.
        filtered: whether it is played behind the safety filter.
    """
    certificate = policy.certificate
    if certificate is None:
        raise ValueError("the policy has no certificate ('excite falsify --certify' makes one)")
    if certificate.get("filter") and not filtered:
        raise ValueError(
            "the policy's certificate is for experiments behind the safety filter: add --filter"
        )
    largest = [certificate["nearness"], certificate["noise_nearness"]]
    if None in largest or max(largest) >= 1 or certificate.get("violations", 0):
        raise ValueError(f"the policy's certificate says that it is not safe ({policy.claim})")
    if certificate["plant_hash"] != plant.hash:
        raise ValueError(
            f"the policy's certificate is for another plant than this {plant.name!r} "
            "('excite falsify --plant' makes one for it)"
        )
    if (steps := certificate.get("num_steps", policy.layout.num_steps)) < policy.layout.num_steps:
        raise ValueError(
            f"the policy's certificate is for its first {steps} of {policy.layout.num_steps} steps"
        )
    for p in plant.parameters:
        low, high = certificate["uncertainty"].get(p.name, (p.nominal, p.nominal))
        least, most = (Spread.of(spread).value(p, p.nominal, u) for u in (-1, 1))
        slack = 1e-9 * p.scale
        if not (low <= least + slack and most - slack <= high):
            raise ValueError(
                f"the policy's certificate is for another uncertainty: {p.name} {low:g} to "
                f"{high:g} {p.unit}, and a spread of {spread} is {least:g} to {most:g}"
            )


def _require_same(
    kind: str,
    trained: Sequence[Input] | Sequence[Output],
    given: Sequence[Input] | Sequence[Output],
    fields: tuple[str, ...],
) -> None:
    if len(trained) != len(given):
        raise ValueError(f"the policy has {len(trained)} {kind}; the plant has {len(given)}")
    for ours, theirs in zip(trained, given, strict=True):
        if ours.name != theirs.name:
            raise ValueError(
                f"the policy was trained for the {kind[:-1]} {ours.name!r}; "
                f"the plant has {theirs.name!r}"
            )
        for field in fields:
            if getattr(ours, field) != getattr(theirs, field):
                raise ValueError(
                    f"the policy was trained with {field} {getattr(ours, field)!r} of "
                    f"{ours.name!r}; the plant has {getattr(theirs, field)!r}"
                )
