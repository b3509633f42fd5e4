"""Policy files: reading one, and those that come with the package."""

from __future__ import annotations

from pathlib import Path

from .contract import Policy

POLICY_ENDING = ".safetensors"
SHIPPED = Path(__file__).parent / "shipped"


def read_policy(path: Path) -> Policy:
    """The policy in a file.

    Raises:
        ValueError: one sentence for a file that cannot be read or is no sound policy.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return Policy.from_bytes(content, str(path))


def shipped_policies() -> dict[str, Path]:
    """Policies that come with the package, by name; a plant's default has the plant's name."""
    return {path.stem: path for path in sorted(SHIPPED.glob(f"*{POLICY_ENDING}"))}


def policy_path(name: str) -> Path | None:
    """File of the policy a user names: a path, or a shipped policy; None for other words."""
    return Path(name) if name.endswith(POLICY_ENDING) else shipped_policies().get(name)
