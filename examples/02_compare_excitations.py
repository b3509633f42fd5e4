"""Which classical signal identifies a DC motor best? First the bound, then a fit."""

import excite as ex

TRUE = {"R": 2.3, "J": 2.4e-5}
SIGNALS = {"prbs": {"clock": 5}, "chirp": {}, "multisine": {}, "square": {}}


def main() -> None:
    for signal, options in SIGNALS.items():
        bound = ex.information("dc_motor", signal, options=options, params=TRUE, seed=1)
        record = ex.simulate("dc_motor", signal, options=options, params=TRUE, seed=1)
        result = ex.identify(record)
        print(f"\n{signal}: log det {bound.log_det_information:.1f}")
        for name, value in result.params.items():
            low, high = result.ci95(name)
            least = bound.params[name].cramer_rao_percent
            print(f"  {name}: {value:.4g} in [{low:.4g}, {high:.4g}], bound {least:.2g} %")


if __name__ == "__main__":
    main()
