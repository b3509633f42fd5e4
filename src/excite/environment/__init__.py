"""The decision process (`process`), its Gymnasium interface (`gymnasium`), objectives, episodes.

`gymnasium` is imported by its module's name, because it loads Gymnasium.
"""

from .adaptive_contrast import AdaptiveContrastiveGain as AdaptiveContrastiveGain
from .contrast import ContrastiveGain as ContrastiveGain
from .critic import CriticGain as CriticGain
from .episodes import Episodes as Episodes
from .episodes import run_episodes as run_episodes
from .episodes import scored as scored
from .errors import EstimationError as EstimationError
from .errors import OutputError as OutputError
from .information_gain import InformationGain as InformationGain
from .objective import MAX_ERROR as MAX_ERROR
from .objective import MAX_SENSITIVITY as MAX_SENSITIVITY
from .objective import AbstractObjective as AbstractObjective
from .objective import StepData as StepData
from .objective import target_mask as target_mask
from .process import Batch as Batch
from .process import Env as Env
from .process import EnvState as EnvState
from .process import Transition as Transition
from .process import default_objective as default_objective
from .process import reset_batch as reset_batch
from .process import step_batch as step_batch
from .weighted_sum import WeightedSum as WeightedSum
