"""Identification: records to parameters with confidence, and what a record could tell at best.

`identify` fits all records at once, holds what the data cannot see, and says in words how
much the result is worth; `best_possible` says how well an input could do. Command line and
page call these two and show what they return.
"""

from .base import Fitted as Fitted
from .base import Identification as Identification
from .base import write_run as write_run
from .bound import best_possible as best_possible
from .fit import identify as identify
