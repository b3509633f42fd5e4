"""Studies: what is compared, on which plant, which agents are trained, and by which processes.

`spec` is the study file, `agent` what is trained; `tasks` does the work of a study, in the
processes of `workers`; `evaluation` and `statistics` score, `folder` keeps, `table` sums up.
This file imports nothing: `objectives`, `workers` and `progress` are used where JAX must not
be loaded.
"""
