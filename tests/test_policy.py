"""Policies: files that come back or are refused in a sentence, Eq. 2, the network in NumPy."""

import dataclasses
import hashlib
import itertools
import json
import pickle
import re
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import safetensors.numpy
from catalogue import PLANTS, TwoMasses

from excite.description import Output, PlantDescription
from excite.files import tensors_from_bytes, tensors_to_bytes, with_checksum
from excite.plant import Aero2
from excite.policy import (
    FORMAT,
    Layout,
    Policy,
    empty_window,
    forward,
    mismatch,
    observe,
    read_policy,
    scaled_action,
    with_input,
    with_measurement,
)

AERO2 = Aero2.definition
LAYOUT = Layout.of(AERO2, window=4, num_steps=20)


def policy_of(
    description: PlantDescription = AERO2, layout: Layout = LAYOUT, hidden: tuple = (5, 3)
) -> Policy:
    rng = np.random.default_rng(1)
    widths = (layout.size, *hidden, len(layout.input_half))
    weights = tuple(
        (rng.normal(size=(out, into)).astype(np.float32), rng.normal(size=out).astype(np.float32))
        for into, out in itertools.pairwise(widths)
    )
    return Policy(description, layout, weights, {"seed": 7, "study": {"name": "a"}})


POLICY = policy_of()


def contract_of(content: bytes) -> dict[str, Any]:
    return tensors_from_bytes(content, FORMAT, "")[1]


def file_of(
    tensors: dict[str, np.ndarray] | None = None,
    metadata: dict[str, str] | None = None,
    **changes: Any,
) -> bytes:
    """The policy's file, written by the library alone, with something else in it."""
    own, contract = tensors_from_bytes(POLICY.to_bytes(), FORMAT, "")
    for path, value in changes.items():
        *parents, last = path.split("__")
        place = contract
        for parent in parents:
            place = place[parent]
        place[last] = value
    if metadata is None:
        metadata = {"format": FORMAT, "data": json.dumps(contract)}
    return with_checksum(safetensors.numpy.save(own if tensors is None else tensors, metadata))


def tensors_of(policy: Policy = POLICY) -> dict[str, np.ndarray]:
    return dict(tensors_from_bytes(policy.to_bytes(), FORMAT, "")[0])


def refusal(content: bytes) -> str:
    with pytest.raises(ValueError, match=r"^my\.policy: ") as refused:
        Policy.from_bytes(content, "my.policy")
    sentence = str(refused.value)
    assert "\n" not in sentence
    return sentence


# ------------------------------------------------------------------------- the file


@pytest.mark.parametrize("plant", PLANTS)
def test_a_policy_comes_back_from_its_file(plant, tmp_path):
    description = PLANTS[plant].description
    policy = policy_of(description, Layout.of(description, 3, 50), hidden=(4,))
    path = tmp_path / "a.policy"
    path.write_bytes(policy.to_bytes())
    again = read_policy(path)
    assert (again.plant, again.layout) == (policy.plant, policy.layout)
    assert again.provenance == policy.provenance
    for ours, theirs in zip(policy.weights, again.weights, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])
    assert again.hash == policy.hash
    assert again.to_bytes() == policy.to_bytes()


def test_equal_policies_are_equal_files():
    # The library's own order of the metadata is one of two, by chance.
    assert len({policy_of().to_bytes() for _ in range(30)}) == 1


def test_the_file_is_a_safetensors_file_with_a_contract_for_others(tmp_path):
    path = tmp_path / "a.policy"
    path.write_bytes(POLICY.to_bytes())
    with safetensors.safe_open(path, "np") as file:  # pyright: ignore[reportPrivateImportUsage]
        metadata = file.metadata()
        assert set(file.keys()) == {f"{i}.{part}" for i in range(3) for part in ("weight", "bias")}
        np.testing.assert_array_equal(file.get_tensor("1.bias"), POLICY.weights[1][1])
    assert metadata["format"] == "excite policy 1"
    contract = json.loads(metadata["data"])
    assert contract["plant_hash"] == AERO2.hash
    assert contract["layout"]["window"] == 4


@pytest.mark.parametrize("layer", [0, 1, 2])
@pytest.mark.parametrize("part", [0, 1])
def test_the_hash_changes_with_every_weight(layer, part):
    weights = [[array.copy() for array in pair] for pair in POLICY.weights]
    weights[layer][part].flat[-1] = np.nextafter(weights[layer][part].flat[-1], np.float32(9))
    other = dataclasses.replace(POLICY, weights=tuple((m, b) for m, b in weights))
    assert other.hash != POLICY.hash


def test_the_hash_changes_with_the_contract():
    others = (
        dataclasses.replace(POLICY, provenance={"seed": 8}),
        dataclasses.replace(POLICY, layout=Layout.of(AERO2, 4, 21)),
        dataclasses.replace(POLICY, plant=Aero2(g=9.80).description),
    )
    assert len({POLICY.hash, *(other.hash for other in others)}) == 4


def test_weights_are_kept_in_single_precision():
    weights = tuple((m.astype(float), b.astype(float)) for m, b in POLICY.weights)
    doubled = dataclasses.replace(POLICY, weights=weights)
    assert {array.dtype for pair in doubled.weights for array in pair} == {np.dtype(np.float32)}
    assert doubled.hash == POLICY.hash


# --------------------------------------------------------------- files that are refused


@pytest.fixture
def as_users_run_it() -> Iterator[None]:
    """Without the import hook's checks of types, which would find wrong ones first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def test_a_truncated_file_is_refused_wherever_it_ends():
    content = POLICY.to_bytes()
    header = 8 + int.from_bytes(content[:8], "little")
    lengths = {*range(12), *range(12, len(content), 37), header - 1, header, header + 1}
    for length in (*lengths, len(content) - 1):
        assert "truncated, or no excite policy file" in refusal(content[:length])
    assert "truncated" in refusal(content + b"\0")


def test_random_bytes_are_refused():
    rng = np.random.default_rng(0)
    for length in (1, 8, 9, 100, 5000):
        for _ in range(20):
            assert "no excite policy file" in refusal(rng.bytes(length))
            assert refusal(struct.pack("<Q", length) + rng.bytes(length))


@pytest.mark.slow
@pytest.mark.usefixtures("as_users_run_it")
def test_a_flipped_bit_is_refused_wherever_it_is():
    content = policy_of(hidden=()).to_bytes()
    for place in range(len(content)):
        for bit in range(8):
            spoilt = bytearray(content)
            spoilt[place] ^= 1 << bit
            refusal(bytes(spoilt))


def test_a_bit_that_changes_no_meaning_is_refused_too():
    """The hexadecimal digits of an escaped letter may be small or large."""
    content = dataclasses.replace(POLICY, provenance={"by": "é"}).to_bytes()
    assert content.count(rb"\u00e9") == 1
    assert "does not match its checksum" in refusal(content.replace(rb"\u00e9", rb"\u00E9"))


def test_the_checksum_is_that_of_the_file_without_it(tmp_path):
    path = tmp_path / "a.policy"
    path.write_bytes(POLICY.to_bytes())
    with safetensors.safe_open(path, "np") as file:  # pyright: ignore[reportPrivateImportUsage]
        assert file.metadata()["sha256"] == POLICY.hash
    entry = f',"sha256":"{POLICY.hash}"'.encode()
    assert hashlib.sha256(shortened(POLICY.to_bytes(), entry)).hexdigest() == POLICY.hash


def shortened(content: bytes, entry: bytes) -> bytes:
    """The file without an entry of its header."""
    end = 8 + int.from_bytes(content[:8], "little")
    assert content[8:end].count(entry) == 1
    header = content[8:end].replace(entry, b"").rstrip()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[end:]


def test_a_file_of_an_older_version_is_read_with_a_warning():
    old = shortened(POLICY.to_bytes(), f',"sha256":"{POLICY.hash}"'.encode())
    with pytest.warns(UserWarning, match=r"^my\.policy: has no checksum"):
        policy = Policy.from_bytes(old, "my.policy")
    assert policy.to_bytes() == POLICY.to_bytes()


def test_a_field_of_the_header_that_is_not_known_is_covered(tmp_path):
    """Another version may add one."""
    metadata = {"format": FORMAT, "data": json.dumps(contract_of(POLICY.to_bytes()))}
    content = file_of(metadata={**metadata, "certificate": "none"})
    assert Policy.from_bytes(content).hash == POLICY.hash
    refusal(content.replace(b'"certificate":"none"', b'"certificate":"some"'))


def test_a_pickle_is_refused_and_not_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "opened",)

    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        trap = pickle.dumps(Trap(), protocol)
        assert "no excite policy file" in refusal(trap)
        assert refusal(struct.pack("<Q", len(trap)) + trap)
    assert not (tmp_path / "opened").exists()
    pickle.loads(pickle.dumps(Trap()))
    assert (tmp_path / "opened").exists()


@pytest.mark.usefixtures("as_users_run_it")
@pytest.mark.parametrize(("metadata", "sentence"), [
    ({"format": "excite policy 2", "data": "{}"}, "'excite policy 2'; this version reads"),
    ({"format": "excite checkpoint 1", "data": "{}"}, "'excite checkpoint 1'; this version reads"),
    ({"format": "EXCITE POLICY 1", "data": "{}"}, "this version reads 'excite policy 1' files"),
    ({"format": "pt"}, "format 'pt'"),
    ({}, "format 'none'"),
    ({"format": FORMAT}, "no excite policy file"),
    ({"format": FORMAT, "data": ""}, "no excite policy file"),
    ({"format": FORMAT, "data": "{'layout': 1}"}, "no excite policy file"),
    ({"format": FORMAT, "data": "[" * 100_000}, "no excite policy file"),
    ({"format": FORMAT, "data": "{}"}, "incomplete or malformed contract ('layout')"),
    ({"format": FORMAT, "data": "[]"}, "its data are not a JSON object"),
    ({"format": FORMAT, "data": "3"}, "its data are not a JSON object"),
    ({"format": FORMAT, "data": "null"}, "its data are not a JSON object"),
    ({"format": FORMAT, "data": '"layout"'}, "its data are not a JSON object"),
])  # fmt: skip
def test_metadata_that_are_no_contract_are_refused(metadata, sentence):
    assert sentence in refusal(file_of(metadata=metadata))


def test_a_safetensors_file_without_metadata_is_refused():
    assert "format 'none'" in refusal(safetensors.numpy.save(tensors_of()))


HUGE = 10**400  # JSON has no largest number


@pytest.mark.usefixtures("as_users_run_it")
@pytest.mark.parametrize(("path", "value"), [
    ("layout", None), ("layout", []), ("layout", 4), ("layout", {}),
    ("layout", {"window": 4, "num_steps": 20}),
    ("plant", None), ("plant", "aero2"), ("plant", {}), ("provenance", None), ("provenance", 5),
    ("provenance", "abc"),
    ("plant__format", 99), ("plant__dt", None), ("plant__dt", "fast"),
    ("plant__dt", HUGE), ("plant__dt", -1), ("plant__band", 3), ("plant__inputs", []),
    ("plant__inputs", [3]), ("plant__inputs", [{"name": "u"}]), ("plant__substeps", "a"),
    ("layout__output_scale", [1.0, 2.0]), ("layout__output_scale", []),
    ("layout__output_scale", "a"), ("layout__output_scale", None), ("layout__output_scale", ["a"]),
    ("layout__output_scale", [0.0]), ("layout__output_scale", [-1.0]),
    ("layout__output_scale", [float("nan")]), ("layout__output_scale", [float("inf")]),
    ("layout__output_scale", [HUGE]), ("layout__output_scale", [None]),
    ("layout__input_half", [24.1]), ("layout__input_half", [24.0, 24.0]),
    ("layout__input_half", [0.0]), ("layout__input_half", [-1.0]),
    ("layout__input_half", [float("nan")]),
    ("layout__input_half", []), ("layout__input_half", [None]), ("layout__input_half", 24.0),
    ("layout__input_middle", [1.0]), ("layout__input_middle", [float("nan")]),
    ("layout__window", 0), ("layout__window", -4), ("layout__window", 4.0),
    ("layout__window", 4.5), ("layout__window", "4"), ("layout__window", None),
    ("layout__window", True), ("layout__window", [4]), ("layout__window", 5),
    ("layout__window", 3), ("layout__window", 10**9), ("layout__window", HUGE),
    ("layout__num_steps", 0), ("layout__num_steps", -1), ("layout__num_steps", 20.0),
    ("layout__num_steps", "20"), ("layout__num_steps", None), ("layout__num_steps", HUGE),
    ("layout__extra", 1),
], ids=lambda v: str(v)[:20])  # fmt: skip
def test_a_contract_that_is_not_sound_is_refused(path, value):
    Policy.from_bytes(file_of())  # what is spoilt here is sound
    refusal(file_of(**{path: value}))


def test_a_window_that_no_memory_holds_is_refused_without_taking_it():
    tracemalloc.start()
    refusal(file_of(layout__window=10**9))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e7


@pytest.mark.parametrize("key", ["plant", "layout", "provenance"])
def test_a_contract_with_a_part_missing_is_refused(key):
    contract = contract_of(POLICY.to_bytes())
    del contract[key]
    metadata = {"format": FORMAT, "data": json.dumps(contract)}
    assert f"malformed contract ({key!r})" in refusal(file_of(metadata=metadata))


def test_a_layout_of_another_plant_is_refused():
    motor = PLANTS["dc_motor"].description
    other = json.loads(json.dumps(motor.to_dict()))
    sentence = refusal(file_of(plant=other, plant_hash=motor.hash))
    assert "does not belong to the policy's plant" in sentence


def test_a_contract_whose_plant_was_changed_is_refused():
    other = json.loads(json.dumps(POLICY.plant.to_dict()))
    other["constants"][0]["value"] *= 2
    assert "does not have the hash" in refusal(file_of(plant=other))


def spoilt_tensors() -> dict[str, dict[str, np.ndarray]]:
    def changed(**changes: Any) -> dict[str, np.ndarray]:
        tensors = tensors_of() | {k.replace("_", "."): v for k, v in changes.items()}
        return {k: v for k, v in tensors.items() if v is not None}

    first = POLICY.weights[0][0]
    not_finite = {}
    for value in (np.nan, np.inf, -np.inf):
        for name, array in sorted(tensors_of().items()):
            spoilt = array.copy()
            spoilt.flat[-1] = value
            not_finite[f"{name} {value}"] = tensors_of() | {name: spoilt}
    return not_finite | {
        "none": {},
        "first layer missing": {k: v for k, v in tensors_of().items() if k[0] != "0"},
        "middle layer missing": {k: v for k, v in tensors_of().items() if k[0] != "1"},
        "last layer missing": {k: v for k, v in tensors_of().items() if k[0] != "2"},
        "first bias missing": {k: v for k, v in tensors_of().items() if k != "0.bias"},
        "last weight missing": {k: v for k, v in tensors_of().items() if k != "2.weight"},
        "one too many": changed(value=np.zeros(3, np.float32)),
        "one layer too many": changed(
            **{"3_weight": np.zeros((2, 1), np.float32), "3_bias": np.zeros(2, np.float32)}
        ),
        "too narrow": changed(**{"0_weight": first[:, 1:]}),
        "transposed": changed(**{"0_weight": first.T}),
        "flat": changed(**{"0_weight": first.ravel()}),
        "bias as column": changed(**{"0_bias": np.zeros((5, 1), np.float32)}),
        "bias too long": changed(**{"0_bias": np.zeros(6, np.float32)}),
        "double precision": changed(**{"0_weight": np.full_like(first, 1e300, np.float64)}),
        "whole numbers": changed(**{"0_weight": np.ones_like(first, np.int32)}),
        "complex": changed(**{"0_weight": np.ones_like(first, np.complex64)}),
    }


@pytest.mark.parametrize("tensors", spoilt_tensors().values(), ids=spoilt_tensors())
def test_weights_that_are_not_sound_are_refused(tensors):
    refusal(file_of(tensors))


def test_a_bias_that_is_missing_does_not_leave_a_shorter_network():
    # The first of these two layers alone would be a sound network.
    policy = policy_of(hidden=(1,))
    tensors = tensors_of(policy)
    del tensors["1.bias"]
    assert "1.bias" in refusal(tensors_to_bytes(tensors, FORMAT, contract_of(policy.to_bytes())))


def test_a_network_needs_a_layer():
    with pytest.raises(ValueError, match="a policy needs at least one layer"):
        Policy(AERO2, LAYOUT, ())


def test_a_file_that_cannot_be_read_is_told_in_a_sentence(tmp_path):
    with pytest.raises(ValueError, match=r"none\.policy: cannot be read \(No such file"):
        read_policy(tmp_path / "none.policy")
    with pytest.raises(ValueError, match="cannot be read"):
        read_policy(tmp_path)
    (tmp_path / "bad.policy").write_bytes(b"bad")
    with pytest.raises(ValueError, match=r"bad\.policy: truncated, or no excite policy file"):
        read_policy(tmp_path / "bad.policy")


# -------------------------------------------------------------------- another plant


def aero2_with(**changes: Any) -> PlantDescription:
    """The Aero 2 with something else in its input, output or itself."""
    [given], [shown] = AERO2.inputs, AERO2.outputs
    of = {
        "input": lambda v: {"inputs": (dataclasses.replace(given, **v),)},
        "output": lambda v: {"outputs": (dataclasses.replace(shown, **v),)},
        "plant": lambda v: v,
    }
    [(part, values)] = changes.items()
    return dataclasses.replace(AERO2, **of[part](values))


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"input": {"name": "current"}}, "trained for the input 'voltage'; the plant has 'current'"),
    ({"input": {"unit": "mV"}}, "trained with unit 'V' of 'voltage'; the plant has 'mV'"),
    ({"input": {"lower": -12.0}}, r"trained with lower -24.0 of 'voltage'; the plant has -12.0"),
    ({"input": {"upper": 12.0}}, r"trained with upper 24.0 of 'voltage'; the plant has 12.0"),
    ({"output": {"name": "yaw"}}, "trained for the output 'pitch'; the plant has 'yaw'"),
    ({"output": {"unit": "deg"}}, "trained with unit 'rad' of 'pitch'; the plant has 'deg'"),
    ({"output": {"warning_level": 0.1}}, "trained with warning_level .* the plant has 0.1"),
    ({"output": {"warning_level": None}}, "trained with warning_level .* the plant has None"),
    ({"output": {"critical_level": 0.6}}, "trained with critical_level .* the plant has 0.6"),
    ({"output": {"critical_level": None}}, "trained with critical_level .* the plant has None"),
    ({"plant": {"dt": 0.05}}, "sampling time of 0.1 s; 'aero2' has 0.05 s"),
    ({"plant": {"inputs": (*AERO2.inputs, TwoMasses.definition.inputs[0])}},
     "has 1 inputs; the plant has 2"),
    ({"plant": {"outputs": (*AERO2.outputs, Output("rate", "rad/s", 1.0))}},
     "has 1 outputs; the plant has 2"),
])  # fmt: skip
def test_a_plant_with_another_interface_is_refused(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        mismatch(POLICY, aero2_with(**changes))


@pytest.mark.parametrize("description", [
    Aero2(m=1.2).description,
    Aero2(initial_state=jnp.array([0.1, 0.0])).description,
    aero2_with(output={"noise_sd": 0.001}),
    aero2_with(output={"resolution": 0.001}),
    aero2_with(plant={"substeps": 3}),
])  # fmt: skip
def test_a_plant_with_other_numbers_is_excited_with_a_warning(description):
    warning = mismatch(POLICY, description)
    assert warning is not None
    assert AERO2.hash[:8] in warning


def test_the_plant_of_training_gives_no_warning():
    assert mismatch(POLICY, Aero2().description) is None
    again = PlantDescription.from_dict(json.loads(json.dumps(AERO2.to_dict())))
    assert mismatch(POLICY, again) is None


# ---------------------------------------------------------------- Eq. 2, the network


@pytest.mark.parametrize("plant", PLANTS)
def test_an_observation_is_equation_2_and_the_same_in_numpy_and_jax(plant):
    description = PLANTS[plant].description
    layout, rng = Layout.of(description, window=5, num_steps=12), np.random.default_rng(3)
    outputs, inputs = description.outputs, description.inputs
    y = rng.normal(size=(13, len(outputs))) * [o.scale for o in outputs]
    u = rng.uniform([i.lower for i in inputs], [i.upper for i in inputs], (13, len(inputs)))
    windows = {xp: empty_window(xp, layout) for xp in (np, jnp)}
    for k in range(13):
        expected = []
        for i in range(k - 4, k + 1):
            expected += [y[i, j] / o.scale if i >= 0 else 0.0 for j, o in enumerate(outputs)]
        for i in range(k - 5, k):  # the input of step k is what is asked for
            for j, part in enumerate(inputs):
                middle, half = (part.upper + part.lower) / 2, (part.upper - part.lower) / 2
                expected.append((u[i, j] - middle) / half if i >= 0 else 0.0)
        expected.append(k / 12)
        seen = {}
        for xp in (np, jnp):
            windows[xp] = with_measurement(xp, layout, windows[xp], xp.asarray(y[k]))
            seen[xp] = observe(xp, layout, windows[xp], k)
            windows[xp] = with_input(xp, layout, windows[xp], xp.asarray(u[k]))
        assert seen[np].shape == (layout.size,)
        assert isinstance(seen[np], np.ndarray)
        assert seen[np].dtype == seen[jnp].dtype == np.float32
        np.testing.assert_allclose(seen[np], expected, rtol=1e-6)
        np.testing.assert_array_equal(seen[np], seen[jnp])


def test_clocks_follow_equation_2_and_travel_with_the_policy():
    layout = dataclasses.replace(LAYOUT, clocks=(0.02, 0.5))
    for xp in (np, jnp):
        plain = observe(xp, LAYOUT, empty_window(xp, LAYOUT), 7)
        seen = observe(xp, layout, empty_window(xp, layout), 7)
        phase = 2 * np.pi * 7 * np.array([0.02, 0.5])
        np.testing.assert_array_equal(seen[: LAYOUT.size], plain)
        expected = [*np.sin(phase), *np.cos(phase)]
        np.testing.assert_allclose(seen[LAYOUT.size :], expected, atol=1e-6)
        assert seen.shape == (layout.size,)
    policy = policy_of(layout=layout)
    assert Policy.from_bytes(policy.to_bytes()).layout == layout


@pytest.mark.parametrize("clocks", [(0.6,), (0.0,), (-0.1,)])
def test_a_clock_that_cannot_be_is_refused(clocks):
    policy = policy_of(layout=dataclasses.replace(LAYOUT, clocks=clocks))
    with pytest.raises(ValueError, match="clocks of a layout are above 0 and at most half"):
        Policy.from_bytes(policy.to_bytes())


def test_the_paper_observes_161_numbers():
    layout = Layout.of(AERO2)
    assert (layout.window, layout.num_steps, layout.size) == (80, 500, 161)
    assert (layout.input_middle, layout.input_half) == ((0.0,), (24.0,))
    assert layout.output_scale == (np.radians(45),)


@pytest.mark.parametrize(("window", "num_steps"), [(0, 10), (10, 0), (-1, 10)])
def test_a_layout_without_length_is_refused(window, num_steps):
    with pytest.raises(ValueError, match="window and num_steps must be at least 1"):
        Layout.of(AERO2, window, num_steps)


@pytest.mark.parametrize("hidden", [(), (6,), (64, 64), (3, 4, 5)])
def test_the_network_is_that_of_double_precision(hidden):
    description = TwoMasses.definition
    policy = policy_of(description, Layout.of(description, 2, 9), hidden)
    # Small weights, so that hyperbolic tangents are not all one.
    weights = (*((0.3 * m, 0.3 * b) for m, b in policy.weights[:-1]), policy.weights[-1])
    policy, rng = dataclasses.replace(policy, weights=weights), np.random.default_rng(4)
    of_jax = jax.jit(lambda observation: forward(jnp, policy.weights, observation))
    num_clipped = 0
    for _ in range(30):
        observation = rng.normal(size=policy.layout.size).astype(np.float32)
        x = observation.astype(float)
        for i, (matrix, bias) in enumerate(policy.weights):
            last = i == len(policy.weights) - 1
            total = [
                sum(float(w) * value for w, value in zip(row, x, strict=True)) + float(b)
                for row, b in zip(matrix, bias, strict=True)
            ]
            x = np.array(total) if last else np.tanh(total)
        num_clipped += np.sum(np.abs(x) > 1)
        action = policy(observation)
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, np.clip(x, -1, 1), atol=1e-5)
        np.testing.assert_allclose(of_jax(observation), action, atol=1e-5)
    assert 0 < num_clipped < 60


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, -np.inf])
def test_what_cannot_be_seen_is_answered_with_no_action(spoilt):
    """As the environment takes an action that is not finite."""
    policy = policy_of(hidden=())
    observation = np.zeros(policy.layout.size, np.float32)
    observation[0] = spoilt
    action = policy(observation)
    np.testing.assert_array_equal(action, [0.0])
    assert action.dtype == np.float32
    np.testing.assert_array_equal(forward(jnp, policy.weights, jnp.asarray(observation)), action)


@pytest.mark.parametrize("shape", [(8,), (10,), (9, 1), ()])
def test_an_observation_of_another_size_is_refused_with_both(shape):
    with pytest.raises(ValueError, match=rf"has shape \(9,\); got {re.escape(str(shape))}$"):
        POLICY(np.zeros(shape, np.float32))


def test_actions_of_one_are_the_limits():
    description = TwoMasses.definition
    layout = Layout.of(description, 2, 9)
    for xp in (np, jnp):
        np.testing.assert_array_equal(scaled_action(xp, layout, xp.ones(2)), [5.0, 6.0])
        np.testing.assert_array_equal(scaled_action(xp, layout, -xp.ones(2)), [-5.0, 0.0])
        np.testing.assert_array_equal(scaled_action(xp, layout, xp.zeros(2)), [0.0, 3.0])


# ------------------------------------------------------------------- by name, and shown


def test_a_policy_is_saved_and_read_by_name_or_path(tmp_path):
    policy = read_policy("aero2")
    path = tmp_path / "own.safetensors"
    policy.save(path)
    assert read_policy(path).hash == read_policy(str(path)).hash == policy.hash
    with pytest.raises(ValueError, match="--overwrite"):
        policy.save(path)
    with pytest.raises(ValueError, match=r"end in \.safetensors"):
        policy.save(tmp_path / "own.bin")
    with pytest.raises(ValueError, match="unknown policy 'areo2'; did you mean 'aero2'"):
        read_policy("areo2")


def test_a_policy_shows_itself_in_a_few_lines():
    policy = read_policy("aero2")
    lines = repr(policy).splitlines()
    assert len(lines) <= 10  # with its certificate
    assert max(map(len, lines)) <= 80
    for word in ("aero2", "500 steps", "gradient", policy.hash):
        assert word in repr(policy)
