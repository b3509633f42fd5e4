"""The figure of docs/how-to/check-safety.md: the worst experiment that a search found."""

from pathlib import Path

import excite as ex


def main() -> None:
    ranges = {"delay_voltage": (0, 0.1), "initial_state": "2%"}
    found = ex.falsify("chirp", "aero2", uncertainty=ranges, budget=2000)
    print(found)
    found.plot().savefig(Path(__file__).parent / "falsify.png", dpi=80)


if __name__ == "__main__":
    main()
