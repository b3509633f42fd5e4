"""Comparisons: methods x estimators (`methods`), agents trained and evaluated (`seeds`, `run`)."""

from .base import Episodes as Episodes
from .base import Progress as Progress
from .base import estimate_all as estimate_all
from .base import evaluate as evaluate
from .base import wilson as wilson
from .episodes import episodes_data as episodes_data
from .episodes import example_episodes as example_episodes
from .methods import run_benchmark as run_benchmark
from .methods import write_benchmark as write_benchmark
