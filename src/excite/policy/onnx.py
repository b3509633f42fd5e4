"""A policy as ONNX: one file that other tools can run without Python and this package.

The graph holds the network alone, from the observation of Eq. 2 to an action in [-1, 1];
the program that runs it keeps the window of measurements and inputs. The contract defines
the window; it is in the model's metadata as JSON, as in the policy's file.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

try:
    import onnx
    from onnx import NodeProto, TensorProto, ValueInfoProto, helper, numpy_helper
except ImportError:
    onnx: Any = None
    TensorProto = helper = numpy_helper = onnx

from .. import __version__
from ..files import json_text, require_new_file, tensors_from_bytes, write_bytes
from .contract import FORMAT, Policy

ONNX_ENDING = ".onnx"
_OPSET = 13  # of 2020, supported by all runtimes in use


def to_onnx(policy: Policy) -> bytes:
    """Content of an ONNX file: `observation` [batch, size] to `action` [batch, input].

    Both are single precision; a single observation is a batch of one. A policy with a memory also
    takes `memory` [batch, size], zero before the first observation, and gives `next_memory`.
    Metadata: `format`, `contract` (plant, layout, provenance as JSON), `policy_hash`.

    Raises:
        ValueError: one sentence where onnx is not installed.
    """
    if onnx is None:
        raise ValueError("exporting needs onnx: pip install 'excite[onnx]'")
    nodes, constants = _network(policy)
    memory = policy.layout.memory
    graph = helper.make_graph(
        nodes,
        f"policy for {policy.plant.name}",
        [_batch("observation", policy.layout.size), *[_batch("memory", memory)] * bool(memory)],
        [
            _batch("action", len(policy.layout.input_half)),
            *[_batch("next_memory", memory)] * bool(memory),
        ],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    opsets = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(
        graph,
        opset_imports=opsets,
        ir_version=helper.find_min_ir_version_for(opsets),
        producer_name="excite",
        producer_version=__version__,
    )
    _, contract = tensors_from_bytes(policy.to_bytes(), FORMAT, "policy")
    about = {"format": FORMAT, "contract": json_text(contract), "policy_hash": policy.hash}
    helper.set_model_props(model, about)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def require_onnx_path(path: Path, overwrite: bool) -> None:
    """Raises ValueError where an ONNX file may not be written."""
    if path.suffix.lower() != ONNX_ENDING:
        raise ValueError(f"{path}: an ONNX file ends in {ONNX_ENDING}")
    require_new_file(path, overwrite)


def write_onnx(policy: Policy, path: Path, overwrite: bool = False) -> None:
    """Writes the ONNX file of a policy, completely or not at all.

    Raises:
        ValueError: one sentence where it may not or cannot be written.
    """
    require_onnx_path(path, overwrite)
    write_bytes(path, to_onnx(policy))


def _batch(name: str, size: int) -> ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])


def _network(policy: Policy) -> tuple[list[NodeProto], dict[str, np.ndarray]]:
    """Nodes and constants of `policy.act`, from an observation on."""
    constants = {"zero": np.array(0, np.float32)}
    nodes, into, layers = [], "observation", policy.weights
    if policy.layout.memory:
        nodes, unit = _unit(policy)
        constants, into, layers = constants | unit, "seen", layers[len(policy.layout.unit) :]
    for i, (matrix, bias) in enumerate(layers):
        if i:
            nodes.append(helper.make_node("Tanh", [into], [f"{i}.tanh"]))
            into = f"{i}.tanh"
        constants |= {f"{i}.weight": matrix, f"{i}.bias": bias}
        words = [into, f"{i}.weight", f"{i}.bias"]
        into = f"{i}.sum"
        nodes.append(helper.make_node("Gemm", words, [into], transB=1))
    if policy.layout.memory:
        bounded = helper.make_node("Tanh", [into], ["bounded"])
    else:
        constants |= {"lowest": np.array(-1, np.float32), "highest": np.array(1, np.float32)}
        bounded = helper.make_node("Clip", [into, "lowest", "highest"], ["bounded"])
    nodes += [
        bounded,
        helper.make_node("IsNaN", [into], ["is_nan"]),
        helper.make_node("IsInf", [into], ["is_infinite"]),
        helper.make_node("Or", ["is_nan", "is_infinite"], ["is_not_finite"]),
        helper.make_node("Where", ["is_not_finite", "zero", "bounded"], ["action"]),
    ]
    return nodes, constants


def _unit(policy: Policy) -> tuple[list[NodeProto], dict[str, np.ndarray]]:
    """Nodes and constants of the memory, and of what the layers after it see."""
    nodes, constants = {"gru": _gru, "sum": _sum, "attention": _attention}[
        policy.layout.memory_kind
    ](policy)
    constants["beside"] = policy.layout.beside_memory.astype(np.int64)
    nodes += [
        helper.make_node("Gather", ["observation", "beside"], ["also"], axis=1),
        helper.make_node("Concat", ["new", "also"], ["seen"], axis=1),
        # Zero times what is not finite is NaN: such an observation is not remembered.
        helper.make_node("Mul", ["observation", "zero"], ["nothing"]),
        helper.make_node("ReduceSum", ["nothing", "last"], ["sum"]),
        helper.make_node("IsNaN", ["sum"], ["is_unseen"]),
        helper.make_node("Where", ["is_unseen", "memory", "new"], ["next_memory"]),
    ]
    return nodes, {"last": np.array([1], np.int64)} | constants


def _sum(policy: Policy) -> tuple[list[NodeProto], dict[str, np.ndarray]]:
    """Nodes and constants of `policy.contract.added`."""
    layout, ((first, first_bias), (last, last_bias)) = policy.layout, policy.weights[:2]
    root = np.float32(math.sqrt(layout.num_steps))
    constants = {
        "newest": np.array(layout.newest, np.int64),
        "progress": np.array([layout.progress], np.int64),
        "encoder.0.weight": first,
        "encoder.0.bias": first_bias,
        "encoder.1.weight": last / root,
        "encoder.1.bias": last_bias / root,
    }
    hidden = ["sample", "encoder.0.weight", "encoder.0.bias"]
    encoded = ["inner", "encoder.1.weight", "encoder.1.bias"]
    nodes = [
        helper.make_node("Gather", ["observation", "newest"], ["sample"], axis=1),
        helper.make_node("Gemm", hidden, ["inner_sum"], transB=1),
        helper.make_node("Tanh", ["inner_sum"], ["inner"]),
        helper.make_node("Gemm", encoded, ["encoded"], transB=1),
        helper.make_node("Gather", ["observation", "progress"], ["done"], axis=1),
        helper.make_node("Greater", ["done", "zero"], ["is_sample"]),
        helper.make_node("Where", ["is_sample", "encoded", "zero"], ["more"]),
        helper.make_node("Add", ["memory", "more"], ["new"]),
    ]
    return nodes, constants


def _attention(policy: Policy) -> tuple[list[NodeProto], dict[str, np.ndarray]]:
    """Nodes and constants of `policy.contract.attended`."""
    layout, memory = policy.layout, policy.layout.memory
    names = "outputs", "inputs"
    ends = 0, layout.window * len(layout.output_scale), layout.progress
    constants = {
        "progress": np.array([layout.progress], np.int64),
        "steps": np.array(layout.num_steps, np.float32),
        "age": np.arange(layout.window, dtype=np.float32)[::-1] + np.float32(0.5),
        "root": np.array(math.sqrt(memory), np.float32),
        "root_of_steps": np.array(math.sqrt(layout.num_steps), np.float32),
        "never": np.array(-1e9, np.float32),
        "samples_axis": np.array([1], np.int64),
        "in_a_sample": np.array([2], np.int64),
    }
    nodes = [
        helper.make_node("Gather", ["observation", "progress"], ["done"], axis=1),
        helper.make_node("Mul", ["done", "steps"], ["count"]),
        helper.make_node("Less", ["age", "count"], ["is_sample"]),
        helper.make_node("Unsqueeze", ["is_sample", "samples_axis"], ["is_key"]),
        helper.make_node("Unsqueeze", ["is_sample", "in_a_sample"], ["is_row"]),
    ]
    for name, start, end in zip(names, ends, ends[1:], strict=False):
        constants[f"{name}.places"] = np.arange(start, end)
        constants[f"{name}.shape"] = np.array([-1, layout.window, (end - start) // layout.window])
        words = ["observation", f"{name}.places"], [f"{name}.flat"]
        nodes.append(helper.make_node("Gather", *words, axis=1))
        nodes.append(helper.make_node("Reshape", [f"{name}.flat", f"{name}.shape"], [name]))
    nodes.append(helper.make_node("Concat", list(names), ["samples"], axis=2))
    layers = ("samples", "inner_sum"), ("inner", "encoded"), ("encoded", "read")
    for i, ((into, out), (matrix, bias)) in enumerate(zip(layers, policy.weights, strict=False)):
        constants |= {f"unit.{i}.weight": matrix.T.copy(), f"unit.{i}.bias": bias}
        nodes.append(helper.make_node("MatMul", [into, f"unit.{i}.weight"], [f"unit.{i}"]))
        nodes.append(helper.make_node("Add", [f"unit.{i}", f"unit.{i}.bias"], [out]))
        if i == 0:
            nodes.append(helper.make_node("Tanh", ["inner_sum"], ["inner"]))
    nodes += [
        helper.make_node("Split", ["read"], ["queries", "keys", "values"], axis=2),
        helper.make_node("Transpose", ["keys"], ["turned"], perm=[0, 2, 1]),
        helper.make_node("MatMul", ["queries", "turned"], ["products"]),
        helper.make_node("Div", ["products", "root"], ["scores"]),
        helper.make_node("Where", ["is_key", "scores", "never"], ["allowed"]),
        helper.make_node("Softmax", ["allowed"], ["shares"], axis=2),
        helper.make_node("MatMul", ["shares", "values"], ["found"]),
        helper.make_node("Add", ["encoded", "found"], ["each"]),
        helper.make_node("Where", ["is_row", "each", "zero"], ["counted"]),
        helper.make_node("ReduceSum", ["counted", "samples_axis"], ["whole"], keepdims=0),
        helper.make_node("Div", ["whole", "root_of_steps"], ["new"]),
    ]
    return nodes, constants


def _gru(policy: Policy) -> tuple[list[NodeProto], dict[str, np.ndarray]]:
    """Nodes and constants of `policy.contract.gated`; ONNX has the gates keep, reset, candidate."""
    memory = policy.layout.memory

    def ordered(array: np.ndarray) -> np.ndarray:
        reset, keep, candidate = np.split(array, 3)
        return np.concatenate([keep, reset, candidate])[None]

    (into, into_bias), (back, back_bias) = policy.weights[:2]
    constants = {
        "first": np.array([0], np.int64),
        "unit.W": ordered(into),
        "unit.R": ordered(back),
        "unit.B": np.concatenate([ordered(into_bias), ordered(back_bias)], axis=1),
    }
    words = ["sequence", "unit.W", "unit.R", "unit.B", "", "before"]
    nodes = [
        helper.make_node("Unsqueeze", ["observation", "first"], ["sequence"]),
        helper.make_node("Unsqueeze", ["memory", "first"], ["before"]),
        helper.make_node("GRU", words, ["", "after"], hidden_size=memory, linear_before_reset=1),
        helper.make_node("Squeeze", ["after", "first"], ["new"]),
    ]
    return nodes, constants
