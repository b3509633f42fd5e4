"""Policies: a network and its contract (`contract`), in one file (`file`), or as ONNX (`onnx`)."""

from .contract import FORMAT as FORMAT
from .contract import NO_MEMORY as NO_MEMORY
from .contract import AnyArray as AnyArray
from .contract import Layout as Layout
from .contract import Policy as Policy
from .contract import Weights as Weights
from .contract import Window as Window
from .contract import act as act
from .contract import empty_window as empty_window
from .contract import forward as forward
from .contract import guard_of as guard_of
from .contract import mismatch as mismatch
from .contract import network as network
from .contract import observe as observe
from .contract import require_certified as require_certified
from .contract import respond as respond
from .contract import scaled_action as scaled_action
from .contract import shown_nearness as shown_nearness
from .contract import with_input as with_input
from .contract import with_measurement as with_measurement
from .file import POLICY_ENDING as POLICY_ENDING
from .file import SHIPPED as SHIPPED
from .file import policy_path as policy_path
from .file import read_policy as read_policy
from .file import shipped_policies as shipped_policies
