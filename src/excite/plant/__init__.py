"""Plants: the contract (`base`) and one file per shipped plant."""

from .aero2 import Aero2 as Aero2
from .aero2 import Aero2Detailed as Aero2Detailed
from .aero2 import Aero2Lag as Aero2Lag
from .base import AbstractARXPlant as AbstractARXPlant
from .base import AbstractPlant as AbstractPlant
from .base import Params as Params
from .base import Sensor as Sensor
from .base import draw_params as draw_params
from .base import params_from as params_from
from .cart_pole import CartPole as CartPole
from .dc_motor import DCMotor as DCMotor
from .emps import EMPS as EMPS
