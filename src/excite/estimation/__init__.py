"""Estimators: the contract (`base`), `ARX`, `NLS` and `Decrement`."""

from .arx import ARX as ARX
from .base import AbstractEstimator as AbstractEstimator
from .base import Estimate as Estimate
from .base import Experiments as Experiments
from .base import Status as Status
from .base import bound_reached as bound_reached
from .base import stack_experiments as stack_experiments
from .decrement import Decrement as Decrement
from .nls import NLS as NLS
