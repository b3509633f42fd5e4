"""Tables, figures and HTML pages from plain data (records, descriptions, rows).

Nothing here computes an experiment or loads JAX. Import modules by name: those of numbers
and tables are fast to load, those of figures and pages load Matplotlib.
"""
