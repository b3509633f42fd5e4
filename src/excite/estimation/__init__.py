"""Estimators: the contract (`contract`), `NLS`, `PEM`, `ARX` and `Decrement`."""

from .arx import ARX as ARX
from .contract import AbstractEstimator as AbstractEstimator
from .contract import Estimate as Estimate
from .contract import Experiments as Experiments
from .contract import Status as Status
from .contract import bound_reached as bound_reached
from .contract import stack_experiments as stack_experiments
from .decrement import Decrement as Decrement
from .nls import NLS as NLS
from .pem import PEM as PEM
from .prior import Prior as Prior
