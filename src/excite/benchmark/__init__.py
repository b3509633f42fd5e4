"""Comparisons: methods x estimators (`base`), agents trained and evaluated (`seeds`, `run`)."""

from .base import Episodes as Episodes
from .base import Progress as Progress
from .base import estimate_all as estimate_all
from .base import evaluate as evaluate
from .base import run_benchmark as run_benchmark
from .base import wilson as wilson
from .base import write_benchmark as write_benchmark
from .episodes import episodes_data as episodes_data
from .episodes import example_episodes as example_episodes
