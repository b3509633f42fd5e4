"""What an experiment is worth: the reward of the decision process.

The error of the ARX estimate at the end (the paper's), the information gained at every
step, which any plant has, the error of the output-error estimate at the end, and weighted
sums of them. Their memory does not grow with time.
"""

from .base import MAX_ERROR as MAX_ERROR
from .base import MAX_SENSITIVITY as MAX_SENSITIVITY
from .base import AbstractObjective as AbstractObjective
from .base import Sample as Sample
from .base import number as number
from .base import prior_sd_of as prior_sd_of
from .base import target_mask as target_mask
from .errors import EstimationError as EstimationError
from .errors import OutputError as OutputError
from .gain import InformationGain as InformationGain
from .sum import WeightedSum as WeightedSum
