"""From plain data (records, descriptions, rows) to tables, figures and pages that people read.

Nothing here computes an experiment or loads JAX. Modules are imported by name: those of
numbers and tables load at once, those of figures and pages load Matplotlib.
"""
