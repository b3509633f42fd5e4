"""From simulation to the rig: experiments in real time, supervised and recorded.

`base` is the contract of a rig, of what plays on it, and the record that grows with an
experiment; `loop` runs one, both with NumPy alone. Rigs: `simulated`, `quanser`, `fmu`.
`prediction` is a safety filter, `tracking` an estimate while the experiment runs. What
needs JAX or an extra is imported by its module's name.
"""

from .base import AbstractPlayer as AbstractPlayer
from .base import AbstractRig as AbstractRig
from .base import Pacer as Pacer
from .base import PolicyPlayer as PolicyPlayer
from .base import Reading as Reading
from .base import Recorder as Recorder
from .base import RigError as RigError
from .base import Sample as Sample
from .base import SignalPlayer as SignalPlayer
from .base import step_seconds as step_seconds
from .loop import Outcome as Outcome
from .loop import interruptible as interruptible
from .loop import run as run
