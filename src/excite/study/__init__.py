"""Studies: comparisons of methods and trainings of agents on a plant.

`spec` reads the study file, `agent` defines what is trained. `engine` runs the `tasks` of a study
in a `pool` of processes, each a `worker`, or on a `cluster`. `methods` and `statistics` compute
scores, `folder` stores files, `table` makes the table. This file imports nothing, because
`objectives`, `pool` and `progress` are used where JAX must not be loaded.
"""
