"""`excite export`: a policy in the format of other tools."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT_FILE, json_option, show_json


@click.command()
@click.argument("policy")
@click.option("--onnx", type=OUT_FILE, required=True, metavar="FILE", help="ONNX model (.onnx).")
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
@json_option
def export(policy: str, onnx: Path, overwrite: bool, as_json: bool) -> None:
    """Write POLICY, a file or a shipped name, as an ONNX model."""
    from ..policy import read_policy
    from ..policy.onnx import require_onnx_path, write_onnx

    require_onnx_path(onnx, overwrite)
    read = read_policy(policy)
    write_onnx(read, onnx, overwrite)
    result = {
        "policy": policy,
        "plant": read.plant.name,
        "observation": read.layout.size,
        "memory": read.layout.memory,
        "action": len(read.layout.input_half),
        "bytes": onnx.stat().st_size,
        "hash": read.hash,
        "file": str(onnx),
    }
    if as_json:
        show_json(result)
    else:
        size = f"memory [batch, {read.layout.memory}]"
        before, after = (f" and {word}{size}" * bool(read.layout.memory) for word in ("", "next_"))
        click.echo(
            f"{onnx}: observation [batch, {result['observation']}]{before} to action "
            f"[batch, {result['action']}]{after}, {result['bytes']} bytes"
        )
