"""Sections of a report, one per run: an experiment, a record, or a study."""
