"""Excitations: the contract (`contract`), signals, and excitations with feedback."""

from .contract import AbstractExcitation as AbstractExcitation
from .contract import AbstractShape as AbstractShape
from .contract import AbstractSignal as AbstractSignal
from .contract import crest_factor as crest_factor
from .feedback import Coast as Coast
from .feedback import PolicyExcitation as PolicyExcitation
from .feedback import PositionLoop as PositionLoop
from .signals import PRBS as PRBS
from .signals import Chirp as Chirp
from .signals import Decay as Decay
from .signals import Multisine as Multisine
from .signals import NoInput as NoInput
from .signals import Random as Random
from .signals import Replay as Replay
from .signals import Square as Square
from .signals import maximum_length_sequence as maximum_length_sequence
