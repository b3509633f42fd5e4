"""Open-loop designs: signals optimised by gradient, classical signals tuned by search."""

from .base import signal_env as signal_env
from .optimal import Design as Design
from .optimal import clairvoyant_signals as clairvoyant_signals
from .optimal import robust_signal as robust_signal
