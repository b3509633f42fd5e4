"""What is asked of a designed signal: the criterion, the prior and the length of a design."""

from __future__ import annotations

from ..env import Env
from ..objective import InformationGain, prior_sd_of
from ..plant import AbstractPlant
from ..policy import Layout


def signal_env(plant: AbstractPlant, num_steps: int, spread: float, criterion: str = "D") -> Env:
    """The decision process of a designer who sees nothing of the experiment.

    All parameters count alike, as where information is reported.
    """
    every = (True,) * len(plant.definition.parameters)
    objective = InformationGain(every, prior_sd_of(spread), criterion=criterion, dense=False)
    layout = Layout.of(plant.description, window=1, num_steps=num_steps)
    return Env.of(plant, objective=objective, layout=layout, spread=spread)
