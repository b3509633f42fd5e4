"""Experiment files: `record` defines and writes them, `read` reads and `prepare` checks them.

`formats` has the kinds of files, `text` the text files from any source, `dates` and `units` what
cells mean. Nothing here needs JAX, and to write and read excite's own CSV NumPy is enough.
"""

from .formats import column_lengths as column_lengths
from .formats import columns_in as columns_in
from .prepare import is_even as is_even
from .prepare import require_columns as require_columns
from .prepare import require_even as require_even
from .prepare import require_playable as require_playable
from .prepare import require_within_limits as require_within_limits
from .prepare import unbroken as unbroken
from .read import SIGNAL_ENDINGS as SIGNAL_ENDINGS
from .read import read_record as read_record
from .read import read_signal as read_signal
from .record import READ_ENDINGS as READ_ENDINGS
from .record import RECORD_KIND as RECORD_KIND
from .record import WRONG_ENDING as WRONG_ENDING
from .record import Record as Record
from .record import described_in as described_in
from .record import require_record_path as require_record_path
from .record import write_record as write_record
from .table import DataFrame as DataFrame
