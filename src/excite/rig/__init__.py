"""From simulation to the rig: experiments in real time, supervised and recorded.

`session.run` runs one experiment from names to its record. Behind it: `contract` (what a
rig is), `player` (what proposes inputs), `loop` (the real-time loop) and `recorder` (the
record on disk) and `watchdog` (a process that outlives this one), all with NumPy alone;
rigs in `simulated`, `quanser` and `fmu`, by name in `catalogue`; `excitation` plays any
excitation, `filter` is a predictive safety filter, `guard` notices a plant that is not as
declared, `live_estimate` estimates while the experiment runs. Modules that need JAX or an
extra are imported by name.
"""

from .contract import AbstractRig as AbstractRig
from .contract import Interval as Interval
from .contract import Pacer as Pacer
from .contract import Reading as Reading
from .contract import RigError as RigError
from .contract import Sample as Sample
from .loop import Outcome as Outcome
from .loop import Stop as Stop
from .loop import interruptible as interruptible
from .loop import run_loop as run_loop
from .player import AbstractPlayer as AbstractPlayer
from .player import PolicyPlayer as PolicyPlayer
from .player import SignalPlayer as SignalPlayer
from .player import step_seconds as step_seconds
from .recorder import Recorder as Recorder
from .watchdog import Watchdog as Watchdog
