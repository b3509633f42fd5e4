"""Study files: what is compared, on which plant, and which agents are trained for it."""

from .agent import Agent as Agent
from .agent import AgentSettings as AgentSettings
from .agent import DecisionSettings as DecisionSettings
from .spec import Study as Study
from .spec import read_study as read_study
from .spec import study_from as study_from
