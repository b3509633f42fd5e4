"""Policy files: reading one, and the shipped ones."""

from __future__ import annotations

from pathlib import Path

from ..description import Listing, path_from, unknown
from .contract import Policy

POLICY_ENDING = ".safetensors"
_ALLOWED = "a name or a path"
SHIPPED = Path(__file__).parent / "shipped"


def read_policy(policy: str | Path) -> Policy:
    """A shipped policy by name, or the policy in a file.

        >>> import excite as ex
        >>> ex.read_policy("aero2").layout.num_steps
        500

    Raises:
        ValueError: one sentence for an unknown name, a file that cannot be read, or one that
            is not a valid policy.
    """
    policy = policy if isinstance(policy, Path) else str(path_from("policy", policy, _ALLOWED))
    path = policy if isinstance(policy, Path) else policy_path(policy)
    if path is None:
        if Path(policy).exists():
            raise ValueError(f"{policy}: policy files end in {POLICY_ENDING}")
        known = [*shipped_policies(), f"path/to/policy{POLICY_ENDING}"]
        raise unknown("policy", str(policy), known)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return Policy.from_bytes(content, str(path))


def shipped_policies() -> dict[str, Path]:
    """Policies that come with the package, by name; a plant's usual one has the plant's name."""
    return {path.stem: path for path in sorted(SHIPPED.glob(f"*{POLICY_ENDING}"))}


def policies() -> Listing:
    """The policies that come with the package, by name.

    >>> import excite as ex
    >>> ex.policies()["aero2"]
    'for aero2, 500 steps: gradient D of the study robust'
    """
    read = {name: read_policy(path) for name, path in shipped_policies().items()}
    return Listing(
        {
            name: f"for {p.plant.name}, {p.layout.num_steps} steps: {p.provenance['agent']} of "
            f"the study {p.provenance['study']}"
            for name, p in read.items()
        }
    )


def policy_path(name: str) -> Path | None:
    """File of a policy, from a path or a shipped name; None for another word."""
    return Path(name) if name.endswith(POLICY_ENDING) else shipped_policies().get(name)
