"""Safe, informative experiments for mechatronic systems, and the parameters they identify.

    >>> import excite as ex
    >>> record = ex.simulate("aero2", "chirp", seed=0)
    >>> result = ex.identify(record)
    >>> result.status
    'successful'

Every verb takes names or objects, and what it returns shows itself. Verbs and nouns are loaded
when they are first used: `import excite` alone costs nothing, and loads neither JAX nor NumPy.
The package computes in double precision, which it switches on when a plant is first used.
"""

import os
import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

__version__ = "0.1.0"

# Threads of XLA, which reads this when JAX first computes. The programs of this package have
# nothing to share among them: handing work over would cost a fifth of a fit.
os.environ.setdefault("NPROC", "1")

_PLACES = {
    # verbs
    "simulate": "simulation",
    "information": "information",
    "information_gain": "estimation.information_gain",
    "identify": "estimation.identify",
    "compare_plants": "estimation.comparison",
    "design": "training.design",
    "train": "study.train",
    "evaluate": "study.evaluate",
    "falsify": "study.falsify",
    "run_study": "study.run",
    "report": "report.report",
    "run": "rig.session",
    "next_experiment": "study.next_experiment",
    "choose_experiments": "study.selection",
    "discriminate": "study.discrimination",
    "campaign": "study.campaign_on_rig",
    # nouns
    "Record": "record.record",
    "read_record": "record.read",
    "PlantDescription": "description",
    "State": "description",
    "Input": "description",
    "Output": "description",
    "Parameter": "description",
    "Constant": "description",
    "AbstractPlant": "plant.contract",
    "Policy": "policy.contract",
    "read_policy": "policy.file",
    "Study": "study.spec",
    "read_study": "study.spec",
    "Identification": "estimation.result",
    "Myopic": "estimation.myopic",
    "Campaign": "study.campaign",
    # what there is
    "plants": "plant.catalogue",
    "excitations": "excitation.catalogue",
    "policies": "policy.file",
    "estimators": "estimation.catalogue",
    "studies": "study.catalogue",
}
"""The module behind each name."""

__all__ = ["__version__", *_PLACES]  # pyright: ignore[reportUnsupportedDunderAll]


class _Verb(ModuleType):
    """A module with the name of a verb; called, it is the verb."""

    @property
    def __wrapped__(self) -> object:
        name = self.__name__.rpartition(".")[2]
        return getattr(import_module(f".{_PLACES[name]}", __name__), name)

    @property
    def __doc__(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.__wrapped__.__doc__

    def __repr__(self) -> str:
        return repr(self.__wrapped__)

    def __call__(self, *args: object, **options: object) -> object:
        return self.__wrapped__(*args, **options)  # pyright: ignore[reportCallIssue]


class _Package(ModuleType):
    """The package itself: importing `excite.information` sets that name to the module."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in _PLACES and isinstance(value, ModuleType):
            value.__class__ = _Verb
        super().__setattr__(name, value)


_package = sys.modules[__name__]
_package.__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module 'excite' has no attribute {name!r}", name=name, obj=_package)
    found = getattr(import_module(f".{_PLACES[name]}", __name__), name)
    return globals().setdefault(name, found)


def __dir__() -> list[str]:
    return sorted(__all__)


if TYPE_CHECKING:
    from .description import Constant as Constant
    from .description import Input as Input
    from .description import Output as Output
    from .description import Parameter as Parameter
    from .description import PlantDescription as PlantDescription
    from .description import State as State
    from .estimation.catalogue import estimators as estimators
    from .estimation.comparison import compare_plants as compare_plants
    from .estimation.identify import identify as identify
    from .estimation.information_gain import information_gain as information_gain
    from .estimation.myopic import Myopic as Myopic
    from .estimation.result import Identification as Identification
    from .excitation.catalogue import excitations as excitations
    from .information import information as information
    from .plant.catalogue import plants as plants
    from .plant.contract import AbstractPlant as AbstractPlant
    from .policy.contract import Policy as Policy
    from .policy.file import policies as policies
    from .policy.file import read_policy as read_policy
    from .record.read import read_record as read_record
    from .record.record import Record as Record
    from .report.report import report as report
    from .rig.session import run as run
    from .simulation import simulate as simulate
    from .study.campaign import Campaign as Campaign
    from .study.campaign_on_rig import campaign as campaign
    from .study.catalogue import studies as studies
    from .study.discrimination import discriminate as discriminate
    from .study.evaluate import evaluate as evaluate
    from .study.falsify import falsify as falsify
    from .study.next_experiment import next_experiment as next_experiment
    from .study.run import run_study as run_study
    from .study.selection import choose_experiments as choose_experiments
    from .study.spec import Study as Study
    from .study.spec import read_study as read_study
    from .study.train import train as train
    from .training.design import design as design
