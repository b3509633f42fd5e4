"""Which classical signal tells most about a DC motor? Bound first, then a real fit."""

import jax

from excite.estimation.identify import identify
from excite.excitation import PRBS, Chirp, Multisine, Square
from excite.information import best_possible
from excite.plant import DCMotor, params_from
from excite.record import Record
from excite.simulation import run_episode


def main() -> None:
    plant = DCMotor()
    true = params_from(plant, {"R": 2.3, "J": 2.4e-5})
    for excitation in (PRBS(clock=5), Chirp(), Multisine(), Square()):
        run = run_episode(plant, true, excitation, 500, jax.random.key(1))
        bound = best_possible(plant, true, run.inputs, initial_state_known=True)
        record = Record.of_episode(run.time, run.inputs, run.measured, source="simulated")
        result = identify([record], plant, initial_state="known")
        print(f"\n{type(excitation).__name__}: log det {bound.log_det_information:.1f}")
        for name, value in result.params.items():
            low, high = result.ci95(name)
            least = bound.params[name].cramer_rao_percent
            print(f"  {name}: {value:.4g} in [{low:.4g}, {high:.4g}], bound {least:.2g} %")


if __name__ == "__main__":
    main()
