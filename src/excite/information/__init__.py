"""What an experiment tells of the parameters, before anything is estimated.

`fisher`: sensitivities, Fisher information, criteria, Cramér-Rao bound. `identifiability`: which
parameters any experiment, or this one, can determine.
"""

from .fisher import Bound as Bound
from .fisher import Information as Information
from .fisher import InformationResult as InformationResult
from .fisher import Past as Past
from .fisher import Start as Start
from .fisher import a_optimality as a_optimality
from .fisher import best_possible as best_possible
from .fisher import cramer_rao_bound as cramer_rao_bound
from .fisher import d_optimality as d_optimality
from .fisher import e_optimality as e_optimality
from .fisher import experiment_information as experiment_information
from .fisher import fisher_information as fisher_information
from .fisher import information as information
from .fisher import marginal_information as marginal_information
from .fisher import relative_size as relative_size
from .fisher import require_bound as require_bound
from .fisher import require_noise as require_noise
from .fisher import running_information as running_information
from .fisher import sensitivity as sensitivity
from .fisher import start_after as start_after
