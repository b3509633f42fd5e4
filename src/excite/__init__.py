"""Safe, informative experiments for mechatronic systems, and the parameters they identify.

The floor plan, from left to right; a module imports only what stands left of it:

    description    what a plant is, as plain data, and its hash
    files          files and run folders, written whole or not at all
    records        experiment files
    safety         warning and critical level of an output
    plant          the contract of a plant, and the plants that are shipped
    excitation     random, PRBS, chirp, multisine, square, replay
    simulation     `simulate` (noise-free) and `run_episode` (closed loop, sensor noise)
    information    sensitivities, Fisher information, Cramér-Rao bound
    estimation     ARX with recursive least squares; continuous-time nonlinear least squares
    names          the words of the command line and what they stand for
    study          every choice of a comparison, read from a TOML file
    benchmark      methods x estimators on common plants and noise
    identification from recorded experiments to parameters with confidence
    report         records to tables and figures
    cli            the command line

This file imports nothing, so that `import excite` costs nothing.
"""

__version__ = "0.1.0"
