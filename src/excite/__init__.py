"""Safe, informative experiments for mechatronic systems, and the parameters they identify.

The floor plan, from left to right; a module imports only what stands left of it:

    description    what a plant is, as plain data, and its hash
    files          files and run folders, written whole or not at all
    policy         a network and its contract, run by NumPy or JAX, in one file
    records        experiment files
    safety         warning and critical level of an output, penalty, a supervisor's rules
    plant          the contract of a plant, and the plants that are shipped
    excitation     signals laid down beforehand; a position loop, a policy
    simulation     `simulate` (noise-free) and `run_episode` (closed loop, sensor noise)
    information    sensitivities, Fisher information, Cramér-Rao bound
    estimation     recursive least squares, nonlinear least squares, logarithmic decrement
    evaluation     how anything is scored: many experiments, each on a plant of its own
    objective      what an experiment is worth: the error of the estimate, or the information
    env            the decision process: reset and step, one plant or a batch
    gymnasium_env  the same with a Gymnasium face
    training       policies by PPO, or by the gradient of the whole experiment
    names          the words of the command line and what they stand for
    design         robust and clairvoyant signals by gradient, classical ones tuned
    study          every choice of a comparison and of its agents, read from a TOML file
    engine         processes of this computer, or a Dask cluster
    rig            experiments in real time: contract, loop, record; simulated and real rigs
    identification from recorded experiments to parameters with confidence
    benchmark      methods and agents x estimators on common plants and noise
    report         records to tables, figures and pages
    export         a policy as ONNX, for other tools
    live           what the bench page asks for, told event by event
    cli            the command line
    web            the bench page: server, workers, and what a browser may ask for
    policies       policies that are shipped, as data

This file imports nothing, so that `import excite` costs nothing.
"""

__version__ = "0.1.0"
