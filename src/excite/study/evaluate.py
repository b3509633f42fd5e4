"""`evaluate`: one policy on plants drawn at random, as a study of one method."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..description import SpreadLike, by_name, wrong_type
from ..plant import AbstractARXPlant
from ..plant.catalogue import PlantLike, trained_on
from ..plant.uncertainty import Range
from ..policy import POLICY_ENDING, Policy, mismatch, read_policy
from ..progress import SHOWN, Progress
from ..report.study_table import StudyTable
from .methods import compared
from .spec import of_prior, plant_tables, study_from


def evaluate(
    policy: str | Path | Policy,
    plant: PlantLike | None = None,
    *,
    episodes: int = 1000,
    seed: int = 0,
    spread: SpreadLike = 0.3,
    prior: Mapping[str, str] | None = None,
    uncertainty: Mapping[str, Range] | None = None,
    coast: int = 0,
    noise: Mapping[str, float] | None = None,
    estimators: str | Sequence[str] | None = None,
    rig: bool = False,
    filter: bool = False,
    progress: Progress = SHOWN,
) -> StudyTable:
    """Evaluates a policy, not a plant, on plants drawn at random.

        >>> import excite as ex
        >>> table = ex.evaluate("aero2", episodes=4)
        >>> table.rows[0].violations
        0

    Args:
        policy: the name of a shipped one, a file, or the policy.
        plant: its name, `path/to/file.py:ClassName`, the plant or its class; default the
            policy's plant.
        episodes: number of experiments, each on another plant.
        seed: of the plants, the noise and the excitations.
        spread: parameters are uniform in nominal value ± spread times their scale, or within a
            factor (`factor:3`).
        prior: distributions of parameters, as for `information_gain`; the others have the spread.
            The table then has the expected information gain.
        uncertainty: what else may differ, as in `falsify`: plants are drawn from it, and
            estimated as if nothing did.
        coast: samples after an experiment, under the input that ends it, whose outputs count for
            its safety too.
        noise: standard deviation by output, in its unit, where it differs from the plant's.
        estimators: names, default `nls`, and `arx-rls` where the plant has a mapping from ARX.
        rig: whether experiments are made on the plant's simulated rig.
        filter: whether they are also made there behind the predictive safety filter.
        progress: called with a text, how much is done, and the total.

    Raises:
        ValueError: for an argument that is not allowed, or a policy that cannot excite the plant.
    """
    if filter and not rig:
        raise ValueError("the safety filter is part of a rig: filter (--filter) needs rig (--rig)")
    if not isinstance(policy, str | Path | Policy):
        raise wrong_type("policy", policy, "a name, a path or a policy")
    with tempfile.TemporaryDirectory() as folder:
        word = str(policy)
        if isinstance(policy, Policy):
            file = Path(folder) / f"policy{POLICY_ENDING}"
            file.write_bytes(policy.to_bytes())
            word = str(file)
        trained, name = read_policy(word), Path(word).stem
        tables, built = plant_tables(trained_on(trained.plant) if plant is None else plant, noise)
        kinds = ["arx-rls"] * isinstance(built, AbstractARXPlant) + ["nls"]
        settings = {
            "name": name,
            **tables,
            "episodes": episodes,
            "num_steps": trained.layout.num_steps,
            "seed": seed,
            "spread": spread,
            **of_prior(prior),
            "uncertainty": by_name("uncertainty", uncertainty, "a dict of ranges by name"),
            "coast": coast,
            "methods": {name: {"excitation": word}},
            "estimators": {kind: {"kind": kind} for kind in kinds},
            "rig": {"filter": filter} if rig else None,
        }
        study = study_from(settings, "evaluate").changed(estimators=estimators).checked("evaluate")
        if (warning := mismatch(trained, built.description)) is not None:
            warnings.warn(f"{name}: {warning}", stacklevel=2)
        return compared(study, progress)
