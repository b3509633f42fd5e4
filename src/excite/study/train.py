"""`train`: a policy for a plant, as a study of one agent and a chirp."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from pathlib import Path

from ..description import SpreadLike, by_name, path_from, wrong_type
from ..excitation.catalogue import usual_signal
from ..plant import AbstractARXPlant
from ..plant.catalogue import PlantLike
from ..plant.uncertainty import Range
from ..policy import Policy, read_policy
from ..progress import SHOWN, Progress
from .folder import seed_folder
from .objectives import CONTRASTS, decision_of, is_error, rewards_of
from .run import run_study
from .spec import Study, of_prior, plant_tables, study_from
from .table import best_seeds


def train(
    plant: PlantLike,
    out: str | Path | None = None,
    *,
    method: str = "gradient",
    objective: str | Sequence[str] | Mapping[str, float] = "D",
    target: str | Sequence[str] = (),
    goal: Mapping[str, float] | None = None,
    window: int | None = None,
    memory: int | None = None,
    memory_kind: str | None = None,
    clock: float | Sequence[float] = (),
    change_price: float = 0.0,
    contrast_plants: int | None = None,
    training: Mapping[str, object] | None = None,
    updates: int | None = None,
    seeds: int = 1,
    spread: SpreadLike = 0.3,
    prior: Mapping[str, str] | None = None,
    uncertainty: Mapping[str, Range] | None = None,
    coast: int = 0,
    steps: int = 500,
    noise: Mapping[str, float] | None = None,
    episodes: int = 100,
    output_scale: Mapping[str, float] | None = None,
    workers: int | None = 1,
    progress: Progress = SHOWN,
    on_done: Callable[[str], None] = lambda _: None,
    command: str = "",
) -> Policy:
    """Trains a policy that excites a plant, and compares it with a chirp.

    In a task without memory it is compared with random designs.

    Rerun with the same arguments and the same `out` to resume an interrupted training.

        >>> import excite as ex
        >>> small = {"num_plants": 2, "hidden": [4]}
        >>> policy = ex.train("aero2", steps=40, window=5, episodes=2, updates=1, training=small)
        >>> policy.layout.num_steps
        40

    Args:
        plant: its name, `path/to/file.py:ClassName`, the plant or its class.
        out: run folder of the study; without one only the policy is kept.
        method: `gradient` of the simulated experiment, or `ppo`.
        objective: criterion of the Fisher information (`D`, `A`, `E`), a lower bound of the
            expected information gain by comparison with other plants of the prior (`sPCE`),
            with those that the record makes probable (`ACE`), or by a critic that needs no
            likelihood and is trained too (`InfoNCE`, by gradient), or errors of the ARX estimator
            (`relative`, `log`, `goals`) or of nonlinear least squares (`nls`); several are added,
            with weights (`["D", "log=0.1"]` or `{"D": 1, "log": 0.1}`).
        target: parameters in the objective, default the plant's targets.
        goal: relative error that is scaled to one, by parameter.
        window: number of samples observed, default 80.
        memory: numbers in which the policy keeps what it has seen; default none. By gradient only.
        memory_kind: `gru` (default), a gated recurrent unit; `sum`, of the encoded samples, which
            does not depend on their order: for tasks without memory; or `attention`, of each
            sample of the window to the others. With the first two, a window of one sample is
            enough; with attention, take a window as long as the experiment.
        clock: frequencies [Hz] whose sine and cosine are observed too.
        change_price: of the squared change of an input from step to step [1 / input unit²],
            subtracted from the objective, which must be information (`D`, `A`, `E`, `sPCE`,
            `ACE`, `InfoNCE`).
        contrast_plants: with which the true one is compared, default 255, for `ACE` 15.
        training: hyper-parameters of the method (`excite.training.settings`).
        updates: gradient updates, default 1000; the hyper-parameter `num_updates`.
        seeds: independent trainings; the best policy is returned.
        spread: plants are drawn from nominal values ± this fraction, or within a factor
            (`factor:3`).
        prior: distributions of parameters, as for `information_gain`; the others have the spread.
            The objective D is then rewarded in nats, and the comparison has the expected gain.
        uncertainty: what else may differ, as in `falsify`: the policy is trained to be safe
            there too (by gradient), and its file says what a search found.
        coast: samples after an experiment, under the input that ends it, in which it must be safe
            too (by gradient).
        steps: samples of an experiment.
        noise: standard deviation by output, in its unit, where it differs from the plant's.
        episodes: experiments on which the policies are evaluated.
        output_scale: scale by which an observed output is divided, in its unit.
        workers: number of parallel processes, None for one per core.
        progress: called with a text, how much is done, and the total.
        on_done: called with the name of every task that was finished.
        command: stored in the run folder, to repeat the run.

    Raises:
        ValueError: for an argument that is not allowed, or a training that cannot succeed.
        StudyFailedError: where tasks failed; finished tasks are kept in `out`.
    """
    if method == "ppo" and uncertainty:
        raise ValueError(
            "ppo does not train against an uncertainty: leave it out, or take the method gradient"
        )
    own = by_name("training", training)
    if updates is not None:
        if method == "ppo":
            raise ValueError("ppo has no updates (--updates): set its total_steps (--set)")
        if "num_updates" in own:
            raise ValueError("updates and num_updates are the same: give one of the two")
        own["num_updates"] = updates
    rewards = rewards_of(objective, by_name("goal", goal, "a dict by parameter"))
    if change_price:
        priced = next((name for name in rewards if not is_error(name)), None)
        if priced is None:
            raise ValueError(
                "change_price is subtracted from information: it needs the objective D, A, E, "
                f"sPCE, ACE or InfoNCE, got {', '.join(rewards)}"
            )
        rewards[priced]["change_price"] = change_price
    if contrast_plants is not None:
        compared = [reward for reward in rewards.values() if reward["reward"] in CONTRASTS]
        if not compared:
            raise ValueError(
                "contrast_plants are for the objectives sPCE, ACE and InfoNCE: got "
                + ", ".join(rewards)
            )
        for reward in compared:
            reward["contrast_plants"] = contrast_plants
    decision = {
        **decision_of(rewards.values()),
        "output_scale": by_name("output_scale", output_scale, "a dict by output"),
        "window": window,
        "memory": memory,
        "memory_kind": memory_kind,
        "clocks": _several("clock", clock, Real, "a frequency in Hz, or several"),
        "uncertainty": by_name("uncertainty", uncertainty, "a dict of ranges by name"),
    }
    agent = {
        "targets": _several("target", target, str, "the name of a parameter, or several") or None,
        "method": method,
        "decision": {n: v for n, v in decision.items() if v not in (None, [], {})},
        "training": own,
    }
    settings = {
        "episodes": episodes,
        "num_steps": steps,
        "spread": spread,
        **of_prior(prior),
        "coast": coast,
        "seeds": seeds,
    }
    agents = {f"{method}({', '.join(rewards)})": agent}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if out is None else path_from("out", out)
        title = "train" if out is None else folder.absolute().name
        study = _compared(plant, noise, title, settings, agents)
        run_study(
            study, folder, workers=workers, progress=progress, on_done=on_done, command=command
        )
        ((name, seed),) = best_seeds(study, folder).items()
        return read_policy(seed_folder(folder, name, seed) / "policy.safetensors")


def _several(what: str, given: object, kind: type, allowed: str) -> list[object]:
    """One value or several as a list."""
    listed = [given] if isinstance(given, kind) else given
    if not isinstance(listed, Sequence) or isinstance(listed, str):
        raise wrong_type(what, given, allowed)
    return list(listed)


def _compared(
    plant: PlantLike,
    noise: Mapping[str, float] | None,
    name: str,
    settings: Mapping[str, object],
    agents: Mapping[str, object],
) -> Study:
    """The study of these settings; ValueError for one that is not allowed."""
    own, built = plant_tables(plant, noise)
    usual = usual_signal(built)
    kinds = ["nls"] + ["arx-rls"] * isinstance(built, AbstractARXPlant)
    content = {
        "name": name,
        "title": f"{own['plant']}: {next(iter(agents))}",
        **own,
        **settings,
        "agents": agents,
        "methods": {usual: {"excitation": usual}},
        "estimators": {kind: {"kind": kind} for kind in kinds},
    }
    return study_from(content, "train").checked("train")
