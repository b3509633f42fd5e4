"""Studies: what is compared, on which plant, which agents are trained, and by which processes.

This file imports nothing: `workers` and `progress` are used where JAX must not be loaded.
"""
