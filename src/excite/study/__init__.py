"""Studies: comparisons of methods and trainings of agents on a plant.

`spec` reads the study file, `agent` defines what is trained. `tasks` does the work of a study
in the processes of `workers`. `evaluation` and `statistics` compute scores, `folder` stores
files, `table` makes the table. This file imports nothing, because `objectives`, `workers` and
`progress` are used where JAX must not be loaded.
"""
