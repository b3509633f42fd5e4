"""Study files: what is compared, on which plant, and which agents are trained for it."""

from .base import Agent as Agent
from .base import AgentSettings as AgentSettings
from .base import DecisionSettings as DecisionSettings
from .study import Study as Study
from .study import read_study as read_study
from .study import study_from as study_from
