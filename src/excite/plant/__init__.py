"""Plants: the contract (`contract`), one file per shipped plant, names (`catalogue`).

Importing this package switches JAX to double precision (see `contract`).
"""

from .aero2 import Aero2 as Aero2
from .aero2 import Aero2Detailed as Aero2Detailed
from .aero2 import Aero2Lag as Aero2Lag
from .cart_pole import CartPole as CartPole
from .contract import AbstractARXPlant as AbstractARXPlant
from .contract import AbstractPlant as AbstractPlant
from .contract import Params as Params
from .contract import Sensor as Sensor
from .contract import draw_params as draw_params
from .contract import params_from as params_from
from .contract import params_within as params_within
from .contract import require_double_precision as require_double_precision
from .dc_motor import DCMotor as DCMotor
from .emps import EMPS as EMPS
from .fields import floats as floats
from .static import AbstractStaticTask as AbstractStaticTask
from .static import static_description as static_description
