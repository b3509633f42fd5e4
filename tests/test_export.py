"""Policies as ONNX: the same actions by ONNX Runtime, NumPy and JAX; one file with its contract."""

import dataclasses
import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest

from excite.cli import main
from excite.files import tensors_from_bytes
from excite.policy import FORMAT, Policy, forward, read_policy, shipped_policies
from excite.policy import onnx as export_module
from excite.policy.onnx import to_onnx, write_onnx

SHIPPED = shipped_policies()
POLICY = read_policy(SHIPPED["aero2"])


def session_of(content: bytes) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])


def actions_of(content: bytes, observations: np.ndarray) -> np.ndarray:
    [actions] = session_of(content).run(["action"], {"observation": observations})
    return np.asarray(actions)


# ---------------------------------------------------------------- the same network three times


@pytest.mark.parametrize("name", SHIPPED)
def test_three_ways_to_run_a_shipped_policy_agree(name: str):
    policy = read_policy(SHIPPED[name])
    content = to_onnx(policy)
    rng = np.random.default_rng(0)
    # Small observations stay inside [-1, 1], large ones are clipped.
    sizes = np.logspace(-3, 1, 64)[:, None]
    observations = (sizes * rng.normal(size=(64, policy.layout.size))).astype(np.float32)
    actions = actions_of(content, observations)
    assert actions.dtype == np.float32
    assert actions.shape == (64, len(policy.layout.input_half))
    assert np.any(np.abs(actions) < 1)
    by_numpy = np.stack([policy(row) for row in observations])
    by_jax = jax.vmap(lambda row: forward(jnp, policy.weights, row))(jnp.asarray(observations))
    np.testing.assert_allclose(actions, by_numpy, rtol=0, atol=1e-5)
    np.testing.assert_allclose(actions, np.asarray(by_jax), rtol=0, atol=1e-5)
    for row, action in zip(observations[::8], actions[::8], strict=True):
        np.testing.assert_allclose(actions_of(content, row[None])[0], action, rtol=0, atol=1e-6)


def test_actions_are_clipped_and_zero_where_they_are_not_finite():
    matrix, bias = np.full((3, POLICY.layout.size), 1e38, np.float32), np.zeros(3, np.float32)
    head = np.array([[30.0, 0.0, 0.0]], np.float32), np.zeros(1, np.float32)
    linear = dataclasses.replace(POLICY, weights=((matrix[:1], bias[:1]),))
    clipped = dataclasses.replace(POLICY, weights=((matrix, bias), head))
    ones = np.ones(POLICY.layout.size, np.float32)
    rows = np.stack([ones, -ones, ones * np.nan, 0 * ones])
    for policy, expected in ((clipped, [1, -1, 0, 0]), (linear, [0, 0, 0, 0])):
        with np.errstate(all="ignore"):
            by_numpy = [policy(row).item() for row in rows]
        assert by_numpy == expected
        assert actions_of(to_onnx(policy), rows)[:, 0].tolist() == expected


# -------------------------------------------------------------------- one file, self-contained


def test_the_file_holds_the_weights_the_contract_and_nothing_else(tmp_path: Path):
    path = tmp_path / "policy.onnx"
    write_onnx(POLICY, path)
    assert [p.name for p in tmp_path.iterdir()] == ["policy.onnx"]
    assert path.read_bytes() == to_onnx(POLICY)  # equal policies are equal files
    model = onnx.load(path, load_external_data=False)
    assert all(not tensor.external_data for tensor in model.graph.initializer)
    kept = {t.name: onnx.numpy_helper.to_array(t) for t in model.graph.initializer}
    for i, (matrix, bias) in enumerate(POLICY.weights):
        np.testing.assert_array_equal(kept[f"{i}.weight"], matrix)
        np.testing.assert_array_equal(kept[f"{i}.bias"], bias)
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert about["format"] == FORMAT
    assert about["policy_hash"] == POLICY.hash
    contract = json.loads(about["contract"])
    assert contract == tensors_from_bytes(POLICY.to_bytes(), FORMAT, "")[1]
    assert {"plant", "plant_hash", "layout", "provenance", "certificate", "guard"} == set(contract)


def test_another_program_runs_it_without_excite(tmp_path: Path):
    path = tmp_path / "policy.onnx"
    write_onnx(POLICY, path)
    code = (
        "import sys, numpy, onnxruntime\n"
        f"session = onnxruntime.InferenceSession({str(path)!r})\n"
        "[wanted] = session.get_inputs()\n"
        "zeros = numpy.zeros((1, wanted.shape[1]), 'f')\n"
        "print(session.run(None, {wanted.name: zeros})[0].item())\n"
        "assert not {'excite', 'jax', 'torch', 'onnx'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = POLICY(np.zeros(POLICY.layout.size, np.float32)).item()
    assert float(done.stdout) == pytest.approx(expected, abs=1e-5)


# --------------------------------------------------------------------------- the command line


Answer = tuple[int, str, str]


@pytest.fixture
def export(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Answer]:
    def call(*words: object) -> Answer:
        monkeypatch.setattr(sys, "argv", ["excite", "export", *map(str, words)])
        with pytest.raises(SystemExit) as ending:
            main()
        out, err = capsys.readouterr()
        return int(ending.value.code or 0), out, err

    return call


def test_the_command_writes_a_shipped_policy_or_a_file(
    export: Callable[..., Answer], tmp_path: Path
):
    for word in ("dc_motor", SHIPPED["dc_motor"]):
        path = tmp_path / f"{len(str(word))}.onnx"
        code, out, err = export(word, "--onnx", path, "--json")
        assert (code, err) == (0, "")
        policy = read_policy(SHIPPED["dc_motor"])
        assert json.loads(out) == {
            "policy": str(word),
            "plant": "dc_motor",
            "observation": policy.layout.size,
            "memory": 0,
            "action": 1,
            "bytes": path.stat().st_size,
            "hash": policy.hash,
            "file": str(path),
        }
        assert path.read_bytes() == to_onnx(policy)


def test_the_command_says_what_it_wrote(export: Callable[..., Answer], tmp_path: Path):
    code, out, _ = export("aero2", "--onnx", tmp_path / "a.onnx")
    assert code == 0
    assert f"observation [batch, {POLICY.layout.size}] to action [batch, 1]" in out


def test_refusals_are_sentences_and_change_nothing(
    export: Callable[..., Answer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    kept, broken = tmp_path / "kept.onnx", tmp_path / "broken.safetensors"
    kept.write_text("mine")
    broken.write_bytes(SHIPPED["aero2"].read_bytes()[:-5])
    cases: list[tuple[Any, Path, str]] = [
        ("aero2", kept, "exists; choose another name or add --overwrite"),
        ("aero2", tmp_path / "a.safetensors", "an ONNX file ends in .onnx"),
        ("aero2", tmp_path / "nowhere" / "a.onnx", "does not exist"),
        ("aero", tmp_path / "a.onnx", "did you mean 'aero2'?"),
        (broken, tmp_path / "a.onnx", "truncated"),
        (tmp_path / "none.safetensors", tmp_path / "a.onnx", "cannot be read"),
    ]
    for policy, path, sentence in cases:
        code, out, err = export(policy, "--onnx", path)
        assert (code, out) == (2, "")
        assert sentence in err
        assert len(err.splitlines()) == 1
    monkeypatch.setattr(export_module, "onnx", None)
    code, _, err = export("aero2", "--onnx", tmp_path / "a.onnx")
    assert code == 2
    assert "exporting needs onnx: pip install 'excite[onnx]'" in err
    assert kept.read_text() == "mine"
    assert {p.name for p in tmp_path.iterdir()} == {"kept.onnx", "broken.safetensors"}


def test_overwrite_replaces(export: Callable[..., Answer], tmp_path: Path):
    path = tmp_path / "a.onnx"
    path.write_text("old")
    assert export("aero2", "--onnx", path, "--overwrite")[0] == 0
    assert path.read_bytes() == to_onnx(POLICY)


def test_a_policy_of_another_depth():
    layout = dataclasses.replace(POLICY.layout, window=2)
    rng = np.random.default_rng(2)
    widths = [layout.size, 7, 5, 3, 1]
    weights = tuple(
        (rng.normal(size=(b, a)).astype(np.float32), rng.normal(size=b).astype(np.float32))
        for a, b in itertools.pairwise(widths)
    )
    policy = Policy(POLICY.plant, layout, weights, {"note": "größer"})
    rows = rng.normal(size=(9, layout.size)).astype(np.float32)
    expected = np.stack([policy(row) for row in rows])
    np.testing.assert_allclose(actions_of(to_onnx(policy), rows), expected, rtol=0, atol=1e-5)
