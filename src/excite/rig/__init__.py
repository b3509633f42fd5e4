"""From simulation to the rig: experiments in real time, supervised and recorded.

`base` is the contract of a rig, of what plays on it, and the record that grows with an
experiment; `loop` runs one, both with NumPy alone. Rigs: `simulated`, `quanser`, `fmu`.
`prediction` is a safety filter, `tracking` an estimate while the experiment runs. What
needs JAX or an extra is imported by its module's name.
"""

from .contract import AbstractRig as AbstractRig
from .contract import Pacer as Pacer
from .contract import Reading as Reading
from .contract import RigError as RigError
from .contract import Sample as Sample
from .loop import Outcome as Outcome
from .loop import interruptible as interruptible
from .loop import run as run
from .player import AbstractPlayer as AbstractPlayer
from .player import PolicyPlayer as PolicyPlayer
from .player import SignalPlayer as SignalPlayer
from .player import step_seconds as step_seconds
from .recorder import Recorder as Recorder
